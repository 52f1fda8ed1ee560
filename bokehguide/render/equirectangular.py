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
        return (u - u.floor()) * self.width, torch.acos(y.clamp(-1.0, 1.0)) / math.pi * self.height

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
