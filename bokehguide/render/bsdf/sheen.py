"""The layer of KHR_materials_sheen: light that fibres scatter back.

The BRDF is the sheen colour times D V, with the distribution D of Conty Estevez and Kulla 2017 ("Charlie") and the visibility V
of Ashikhmin and Premože 2007. Sheens of low roughness would reflect up to five times the light that arrives at grazing angles.
The BRDF is therefore divided by the larger of 1 and the albedos of both directions. Albedos below 1 stay as in the extension,
and so does the weight of the layers beneath.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.bsdf.microfacets import MIN_COSINE
from bokehguide.render.surface import Surface

MIN_ROUGHNESS = 0.07
"""Least roughness of a sheen. The lobes of smoother sheens lie within half a degree of the horizon."""
ROWS, COLUMNS = 32, 64
"""Size of the table of albedos: roughness, and square roots of cosines."""
STEEPEST = 1e-5
"""Least cosine in the table."""


def brdf(sine2: Tensor, first: Tensor, second: Tensor, alpha: Tensor) -> Tensor:
    """D V of a white sheen of roughness α.

    sine2: squared sine of the angle between normal and half vector; first, second: cosines of both directions to the normal.
    Tensors have any shapes that broadcast.
    """
    return (2.0 + 1.0 / alpha) * sine2 ** (0.5 / alpha) / (8.0 * math.pi * (first + second - first * second))


@cache
def albedo_table() -> Tensor:
    """Albedos of white sheens `[ROWS, COLUMNS]`, by roughness from `MIN_ROUGHNESS` to 1 and by √cosine from 0 to 1.

    Gauss-Legendre quadrature with nodes that are dense near the horizon.
    """
    nodes, weights = map(torch.from_numpy, np.polynomial.legendre.leggauss(48))
    root, azimuth = 0.5 * (nodes + 1.0), 0.5 * math.pi * (nodes + 1.0)
    weight = torch.outer(root**3 * weights, math.pi * weights)  # 2 cos √cos d√cos, twice half a turn
    alpha = torch.linspace(MIN_ROUGHNESS, 1.0, ROWS, dtype=torch.float64)[:, None, None] ** 2
    light, table = (root**2)[:, None], []
    for cosine in (torch.linspace(0.0, 1.0, COLUMNS, dtype=torch.float64) ** 2).clamp(min=STEEPEST):
        along = (1.0 - cosine**2).sqrt() + (1.0 - light**2).sqrt() * azimuth.cos()
        across = (1.0 - light**2).sqrt() * azimuth.sin()
        level = along**2 + across**2
        values = brdf(level / (level + (light + cosine) ** 2), light, cosine, alpha)
        table.append((values * weight).sum((1, 2)))
    return torch.stack(table, dim=1).float()


def sheen_albedo(table: Tensor, cosine: Tensor, roughness: Tensor) -> Tensor:
    """Albedo `[N]` of white sheens, bilinear in √cosine and roughness `[N]`; table: `albedo_table`."""
    x = cosine.clamp(0.0, 1.0).sqrt() * (COLUMNS - 1)
    y = (roughness - MIN_ROUGHNESS).clamp(min=0.0) * ((ROWS - 1) / (1.0 - MIN_ROUGHNESS))
    column, row = x.floor().clamp(max=COLUMNS - 2), y.floor().clamp(max=ROWS - 2)
    x, y, flat = x - column, y - row, table.flatten()
    place = (row * COLUMNS + column).long()
    upper, lower = ((1.0 - x) * flat[place + down] + x * flat[place + down + 1] for down in (0, COLUMNS))
    return (1.0 - y) * upper + y * lower


class Sheen:
    """The sheen of surfaces that are seen from directions with the cosine `cosine` `[N]` to the normal."""

    def __init__(self, cosine: Tensor, surface: Surface):
        assert surface.sheen_color is not None and surface.sheen_roughness is not None
        self._table = albedo_table().to(cosine.device)
        self._cosine, self._color, self._roughness = cosine, surface.sheen_color, surface.sheen_roughness
        self._alpha = self._roughness.clamp(min=MIN_ROUGHNESS).square()
        self._peak = self._color.amax(0)
        self._leaving = sheen_albedo(self._table, cosine, self._roughness)
        self.reflectance = self._peak * self._leaving.clamp(max=1.0)
        """Albedo of the largest channel, `[N]`."""

    def _bound(self, cosine: Tensor) -> Tensor:
        """The larger of the albedos of both directions, `[N]`."""
        return torch.maximum(self._leaving, sheen_albedo(self._table, cosine, self._roughness))

    def beneath(self, cosine: Tensor) -> Tensor:
        """Weight `[N]` of the layers beneath, for light with the cosine `cosine` `[N]` to the normal."""
        return 1.0 - self._peak * self._bound(cosine).clamp(max=1.0)

    def evaluate(self, half: Tensor, cosine: Tensor) -> Tensor:
        """The BRDF `[3, N]`, for incoming cosines `[N]` and half vectors `[3, N]`."""
        sine2 = (half[0].square() + half[1].square()).clamp(max=1.0)
        value = brdf(sine2, cosine, self._cosine, self._alpha)
        return self._color * (value / self._bound(cosine).clamp(min=1.0))


def sample_hemisphere(uniforms: Tensor) -> Tensor:
    """Directions `[3, N]` uniform above the surface, with the density 1 / 2π, from uniforms `[2, N]`."""
    angle, height = 2.0 * math.pi * uniforms[0], 1.0 - uniforms[1]
    radius = (1.0 - height.square()).clamp(min=0.0).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height.clamp(min=MIN_COSINE)))
