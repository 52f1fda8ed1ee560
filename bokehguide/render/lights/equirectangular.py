"""Directions and places on an equirectangular map."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.render.vector import polar_angle


class Equirectangular:
    """Layout of a map `[H, W]` whose centre lies at -z and whose columns grow towards +x.

    Places are in texels from the top left corner. rotation: of the map about y, degrees.
    """

    def __init__(self, height: int, width: int, rotation: float, device: torch.device | str = "cpu"):
        self.height, self.width = height, width
        self.turn = torch.tensor(math.radians(rotation) / (2.0 * math.pi), device=device)

    def place(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Columns and rows `[N]` of unit directions `[3, N]`, from 0 to the map's width and height."""
        x, y, z = directions.unbind(0)
        u = 0.5 + polar_angle(x, -z) / (2.0 * math.pi) + self.turn
        # The arc cosine of y would lose digits near the poles.
        return (u - u.floor()) * self.width, polar_angle((x * x + z * z).sqrt(), y) / math.pi * self.height

    def corner(self, directions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """For the four texels around unit directions `[3, N]`: column and row of the first, -1 beyond the edges, and the offsets
        of the directions from its centre, 0 to 1; `[N]` each."""
        x, y = (place - 0.5 for place in self.place(directions))
        left, top = x.floor(), y.floor()
        return left, top, x - left, y - top

    def texels(self, left: Tensor, top: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """For four texels, given column and row of the first: the first texels of both rows, and both columns, int32 `[N]`."""
        upper, lower = (row.clamp(0.0, self.height - 1.0).int() * self.width for row in (top, top + 1.0))
        first, second = ((column - (column / self.width).floor() * self.width).int() for column in (left, left + 1.0))
        return (upper, lower), (first, second)

    def around(self, column: Tensor, y: Tensor) -> Tensor:
        """Unit directions `[3, N]` at columns `[N]`, of height `y` `[N]` above the horizon."""
        phi = 2.0 * math.pi * (column / self.width - 0.5 - self.turn)
        sine = (1.0 - y * y).clamp(min=0.0).sqrt()
        return torch.stack((sine * phi.sin(), y, -sine * phi.cos()))

    def directions(self, column: Tensor, row: Tensor) -> Tensor:
        """Unit directions `[3, N]` at columns and rows `[N]`."""
        # `around` of the cosine would lose digits near the poles.
        phi, theta = 2.0 * math.pi * (column / self.width - 0.5 - self.turn), math.pi / self.height * row
        sine = theta.sin()
        return torch.stack((sine * phi.sin(), theta.cos(), -sine * phi.cos()))
