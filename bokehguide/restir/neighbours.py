"""Which pixels a pixel borrows samples from: points of the R2 sequence in a disc."""

from __future__ import annotations

import torch
from torch import Tensor

TABLE = 8192
"""Offsets to start from: each pixel takes consecutive ones from a random place on."""


def disc_offsets(count: int) -> Tensor:
    """The first `count` points of the R2 sequence over [-1, 1]² that lie in the unit disc, `[2, count]`.

    Consecutive points are spread evenly (Roberts 2018): steps of 1/g and 1/g², g³ = g + 1.
    """
    g = 1.32471795724474602596
    index = torch.arange(1, 2 * count + 1, dtype=torch.float64)  # π/4 of them lie inside
    square = torch.stack((index / g, index / (g * g))).add(0.5).frac() * 2.0 - 1.0
    return square[:, square.square().sum(0) < 1.0][:, :count].float()


class Neighbourhood:
    """`count` pixels within `radius` pixels of each pixel of a frame.

    Where the disc holds few pixels some of them count more than once.
    """

    def __init__(self, width: int, height: int, radius: float, count: int, device: torch.device | str = "cpu"):
        self.width, self.height = width, height
        self._offsets = (disc_offsets(TABLE) * radius).round().to(torch.int64).to(device)
        self._places = torch.arange(count, device=device)[:, None]

    def of(self, pixels: Tensor, start: Tensor) -> Tensor:
        """Flat indices int64 `[count, N]` of the neighbours of `pixels` int64 `[N]`.

        -1 stands for what would lie off the frame, or be the pixel itself.
        start: uniform numbers `[N]` that choose where in the sequence each pixel begins.
        """
        dx, dy = self._offsets[:, ((start * TABLE).long() + self._places) % TABLE].unbind(0)
        x, y = pixels % self.width + dx, pixels // self.width + dy
        inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height) & ((dx != 0) | (dy != 0))
        return torch.where(inside, y * self.width + x, -1)
