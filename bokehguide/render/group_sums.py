"""Sums of the radiance of light groups over the samples of each pixel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bokehguide.runtime.indexing import Pixels, scatter_add


class GroupSums:
    """The part of a film for light groups. Threads may add batches of different pixels concurrently.

    names: of the groups, empty without groups.
    """

    def __init__(self, names: Sequence[str], pixels: int, device: torch.device | str):
        self.names = names
        self._sums = torch.zeros(3 * len(names), pixels, dtype=torch.float64, device=device)

    def sums(self) -> dict[str, Tensor]:
        """The sums by name, float64 `[3 G, pixels]`, empty without groups."""
        return {"groups": self._sums} if self.names else {}

    def add(self, pixels: Pixels, values: Tensor, kept: Tensor) -> None:
        """Add weighted radiance `[G, 3, N]` of N different pixels; kept: whether a sample counts, bool `[N]`."""
        scatter_add(self._sums, pixels, torch.where(kept, values, 0.0).flatten(0, 1))

    def means(self, count: Tensor) -> Tensor:
        """Mean radiance, float32 `[G, 3, pixels]`; count: samples of each pixel, at least 1, `[pixels]`."""
        return (self._sums / count).float().unflatten(0, (-1, 3))
