"""The record buffer: sums over primary hits in the cells of a pinhole image (section 4.2.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.runtime import native
from bokehguide.runtime.distributed import Ranks, RankSums
from bokehguide.runtime.indexing import ActiveEntries, indices

MARGIN = 0.1
"""Width of the margin around the frame, as a share of the frame's width. The circle of confusion of a highlight in the margin may
reach into the frame."""

WIDEST = 10.0
"""Width over height of a frame up to which the border follows the width: that of a very wide frame would fill the memory."""

FAR = 1000.0
"""Distance at which the record places the environment, in focus distances."""


class Records(NamedTuple):
    """Samples for a record: cells, int64 `[N]`, positions `[3, N]` in the camera frame, and luminance `[N]`."""

    cells: Tensor
    points: Tensor
    luminance: Tensor


class Raster(RankSums):
    """A raster with a margin, whose cells store sums over samples.

    sums: `[planes, cells]`. The first plane is the number of samples, the second is Σ L.
    """

    def __init__(self, camera: ThinLensCamera, planes: int, ranks: Ranks | None = None):
        border = math.ceil(MARGIN * min(camera.width, WIDEST * camera.height))
        width, height = camera.width + 2 * border, camera.height + 2 * border
        super().__init__(torch.zeros(planes, width * height), ranks)
        self.border, self.width, self.height = border, width, height

    def cells(self, camera: ThinLensCamera, points: Tensor) -> Tensor:
        """Cell of each camera-frame point `[3, N]`, int64 `[N]`; -1 outside or behind the lens."""
        column, row = (camera.raster(points) + self.border).floor().nan_to_num(-1.0).clamp(-1.0, 1e6)
        inside = (points[2] > 0.0) & (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        return torch.where(inside, row.long() * self.width + column.long(), -1)

    def radiance(self) -> Tensor:
        """Mean luminance of each cell, `[height, width]`."""
        return (self.sums[1] / self.sums[0].clamp(min=1.0)).reshape(self.height, self.width)


class RecordBuffer(Raster):
    """A raster whose cells store number, radiance and positions of samples.

    The mean position of a cell is weighted by radiance, so that the background hardly moves a small highlight. The mean is over
    slopes and inverse depths, so that a dim environment far behind an emitter hardly moves the emitter.
    sums: `[5, cells]`: count, Σ L, Σ L·(X/Z, Y/Z, 1/Z), camera frame.
    """

    def __init__(self, camera: ThinLensCamera, ranks: Ranks | None = None):
        super().__init__(camera, 5, ranks)

    def add(self, batches: Sequence[Records], threads: int = 1) -> None:
        """Add samples to their cells."""
        core = native.core_on(self.mine.device)
        if core is not None:
            found = [(cells, points.contiguous(), light.contiguous()) for cells, points, light in batches]
            core.add_records(self.mine, found, threads)
            return
        for cells, points, luminance in batches:
            self._add(cells, points, luminance)

    def _add(self, cells: Tensor, points: Tensor, luminance: Tensor) -> None:
        inside = ActiveEntries(cells >= 0)
        cells, light = inside.masked(inside.select(cells), 0), inside.select(luminance)
        x, y, depth = inside.select(points)
        values = (torch.ones_like(light), light, light * (x / depth), light * (y / depth), light * (1.0 / depth))
        for total, value in zip(self.mine, values):
            total.index_add_(0, cells, inside.masked(value, 0.0))

    def bright(self, threshold: float) -> tuple[Tensor, Tensor, Tensor]:
        """Cells int64 `[K]` whose mean luminance is above the threshold, their positions `[3, K]` and mean luminance `[K]`."""
        cells = indices(self.sums[1] > threshold * self.sums[0])
        return cells, self.positions(cells), self.sums[1, cells] / self.sums[0, cells]

    def positions(self, cells: Tensor) -> Tensor:
        """Radiance-weighted mean positions `[3, K]` of cells `[K]` with light."""
        x, y, inverse_depth = self.sums[2:5, cells]
        return torch.stack((x, y, self.sums[1, cells])) / inverse_depth
