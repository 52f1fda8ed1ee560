"""The aperture: a disc on the lens plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Lens:
    """A thin lens with a round aperture.

    Lens points are `[2, N]`, metres, in the camera frame (x right, y up) with the lens
    centre at the origin. Densities are per unit lens area (1/m²).

    radius: aperture radius in metres. focus_distance: metres along the optical axis.
    """

    radius: float
    focus_distance: float

    @property
    def area(self) -> float:
        """A, the aperture's area in m²."""
        return math.pi * self.radius**2

    def contains(self, points: Tensor) -> Tensor:
        """Whether lens points `[2, N]` lie in the aperture, bool `[N]`."""
        x, y = points.unbind(0)
        return x * x + y * y <= self.radius**2

    def sample(self, uniforms: Tensor) -> Tensor:
        """Points `[2, N]` with density 1/A from uniform numbers `[2, N]`; rounding never leaves the rim."""
        radius = self.radius * (1.0 - 1e-6) * uniforms[0].sqrt()
        angle = 2.0 * math.pi * uniforms[1]
        return torch.stack((radius * angle.cos(), radius * angle.sin()))
