"""The neighbours from which a pixel reuses samples: points of the R2 sequence in a disc."""

from __future__ import annotations

import torch
from torch import Tensor

TABLE_SIZE = 8192
"""Number of offsets in the table. Each pixel uses consecutive offsets, from a random start."""


def disc_offsets(count: int) -> Tensor:
    """The first `count` points of the R2 sequence over [-1, 1]² that lie in the unit disc, `[2, count]`.

    Consecutive points are evenly distributed (Roberts 2018): the steps are 1/g and 1/g², with g³ = g + 1.
    """
    g = 1.32471795724474602596
    index = torch.arange(1, 2 * count + 1, dtype=torch.float64)  # the share π/4 of the points lies in the disc
    square = torch.stack((index / g, index / (g * g))).add(0.5).frac() * 2.0 - 1.0
    return square[:, square.square().sum(0) < 1.0][:, :count].float()


class Neighbourhood:
    """Chooses `count` neighbours within `radius` pixels of each pixel of a frame.

    A small disc contains few pixels, so that a pixel may occur more than once.
    """

    def __init__(self, width: int, height: int, radius: float, count: int, device: torch.device | str = "cpu"):
        self.width, self.height = width, height
        self._offsets = (disc_offsets(TABLE_SIZE) * radius).round().to(torch.int64).to(device)
        self._numbers = torch.arange(count, device=device)[:, None]

    def of(self, pixels: Tensor, start: Tensor) -> Tensor:
        """Flat indices int64 `[count, N]` of the neighbours of `pixels` int64 `[N]`; -1 outside the frame and for the pixel
        itself.

        start: uniform numbers `[N]` that choose the first offset of each pixel.
        """
        dx, dy = self._offsets[:, ((start * TABLE_SIZE).long() + self._numbers) % TABLE_SIZE].unbind(0)
        x, y = pixels % self.width + dx, pixels // self.width + dy
        inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height) & ((dx != 0) | (dy != 0))
        return torch.where(inside, y * self.width + x, -1)
