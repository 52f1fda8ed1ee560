"""The pixels of a film: their places in the frame, and the pixels that a rank renders."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.runtime.distributed import Ranks
from bokehguide.runtime.indexing import Pixels, box_pixels, indices


class FilmPixels:
    """The pixels of a film, and the pixels among them that steps render.

    width, height: size of the film. corner: column and row of its first pixel in the frame. rows_per_band: rows of the bands that
    ranks render. own: the pixels that this rank renders. mine: whether this rank renders a pixel, bool `[pixels]`, on the CPU.
    active: the pixels that steps render, int64 `[N]`; None for all pixels.
    """

    def __init__(
        self, camera: ThinLensCamera, window: tuple[int, int, int, int], ranks: Ranks, rows_per_band: int, device: torch.device
    ):
        left, top, self.width, self.height = window
        self.corner = (left, top)
        self._ranks, self._frame_size = ranks, camera.width * camera.height
        whole = window == (0, 0, camera.width, camera.height)
        self._in_frame = None if whole else box_pixels(window, camera.width).to(device)
        """Pixels of the frame that are on the film, int64 `[pixels]`; None if all pixels are."""
        self.active = ranks.rows(self.width, self.height, rows_per_band, device)
        self.own: Pixels = slice(None) if self.active is None else self.active
        self.mine = torch.zeros(self.width * self.height, dtype=torch.bool)
        self.mine[slice(None) if self.active is None else self.active.cpu()] = True

    def render_only(self, chosen: Tensor) -> None:
        """From now on, steps render only the `chosen` pixels of the film, bool `[pixels]`."""
        self.active = indices(chosen & self.mine.to(chosen.device))

    def in_frame(self, places: Pixels) -> Pixels:
        """The pixels of the frame at `places` of the film."""
        return places if self._in_frame is None else self._in_frame[places]

    def mine_in_frame(self) -> Tensor:
        """As `mine`, of the frame's pixels. Pixels outside a crop belong to the first rank."""
        if self._in_frame is None:
            return self.mine
        of_frame = torch.full((self._frame_size,), self._ranks.first)
        return of_frame.index_copy_(0, self._in_frame.cpu(), self.mine)

    def at(self, span: slice) -> Pixels:
        """The pixels of a span of the active pixels."""
        return span if self.active is None else self.active[span]

    def row(self, cuts: np.ndarray | None) -> tuple[int, np.ndarray | None]:
        """Number of active pixels, and the places among them of `cuts` in the film."""
        if self.active is None:
            return self.width * self.height, cuts
        return len(self.active), None if cuts is None else np.unique(np.searchsorted(self.active.cpu().numpy(), cuts))
