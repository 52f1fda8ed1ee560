"""Where directions lie on an equirectangular map."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.render.kernels import record
from bokehguide.render.vector import polar_angle


@record
class Equirectangular:
    """A map `[H, W]` whose centre lies at -z and whose columns go towards +x; places are in texels from its top left corner.

    rotation: degrees by which the map is turned about y.
    """

    def __init__(self, height: int, width: int, rotation: float, device: torch.device | str = "cpu"):
        self.height, self.width = height, width
        self._turn = torch.tensor(math.radians(rotation) / (2.0 * math.pi), device=device)

    def place(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Columns and rows `[N]` of unit directions `[3, N]`, from 0 to the map's width and height."""
        x, y, z = directions.unbind(0)
        u = 0.5 + polar_angle(x, -z) / (2.0 * math.pi) + self._turn
        # Not the arc cosine of y, which has few digits near the poles.
        return (u - u.floor()) * self.width, polar_angle((x * x + z * z).sqrt(), y) / math.pi * self.height

    def corner(self, directions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Column and row of the first of the four texels whose middles lie about unit directions `[3, N]`, -1 beyond the
        edges; and how far the directions are on the way to the last of them, 0 to 1. All `[N]`."""
        x, y = (place - 0.5 for place in self.place(directions))
        left, top = x.floor(), y.floor()
        return left, top, x - left, y - top

    def texels(self, left: Tensor, top: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Of the four texels of which these are column and row of the first: where both rows begin, and both columns, int32 `[N]`."""
        rows = tuple(row.clamp(0.0, self.height - 1.0).int() * self.width for row in (top, top + 1.0))
        columns = tuple((column - (column / self.width).floor() * self.width).int() for column in (left, left + 1.0))
        return rows, columns

    def around(self, column: Tensor, y: Tensor) -> Tensor:
        """Unit directions `[3, N]` of the height `y` `[N]` above the horizon, at columns `[N]`."""
        phi = 2.0 * math.pi * (column / self.width - 0.5 - self._turn)
        sine = (1.0 - y * y).clamp(min=0.0).sqrt()
        return torch.stack((sine * phi.sin(), y, -sine * phi.cos()))

    def directions(self, column: Tensor, row: Tensor) -> Tensor:
        """Unit directions `[3, N]` at columns and rows `[N]`."""
        # Not `around` of the cosine, which has few digits near the poles.
        phi, theta = 2.0 * math.pi * (column / self.width - 0.5 - self._turn), math.pi / self.height * row
        sine = theta.sin()
        return torch.stack((sine * phi.sin(), theta.cos(), -sine * phi.cos()))
