"""Directional albedos of dielectric coats: GGX microfacets with Schlick's reflectance.

The albedo is f0 S + (f90 - f0) B. S is the albedo of microfacets that reflect all light, and B the albedo of microfacets with the
reflectance (1 - cos θ)⁵. Both depend on the angle to the normal and on α, and come from a table. The base under a coat has the
weight (1 - E(incoming)) (1 - E(outgoing)) / (1 - mean of E), with the albedo E of the coat (Kelemen and Szirmay-Kalos 2001).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from bokehguide.render.bsdf.microfacets import Microfacets
from bokehguide.render.geometry import MIN_ALPHA
from bokehguide.render.vector import fifth_power

TABLE = Path(__file__).with_suffix(".npy")
ROWS, COLUMNS = 64, 96
"""Size of the table: rows over the eighth root of α, from `MIN_ALPHA` to 1, and columns over the fourth root of the cosine."""
WIDTH = COLUMNS + 1
"""Columns of the table with the last one, which has the cosine-weighted mean of its row."""
STEEP_MARGIN, GRAZING_MARGIN = 0.4, 0.2
"""Excess of S and B of anisotropic coats over isotropic coats of the same α towards the direction, per difference of both α."""


@cache
def coat_table(device: torch.device) -> Tensor:
    """S and B `[2, ROWS, WIDTH]`, from the file that `scripts/coat_table.py` writes."""
    return torch.from_numpy(np.load(TABLE)).to(device)


class CoatAlbedo:
    """Albedo of coats over `facets`, with Schlick's reflectance f0 + rise (1 - cos θ)⁵; f0, rise: `[N]`.

    For anisotropic coats, the albedo is an upper bound, fitted to numerical integrals.
    """

    def __init__(self, facets: Microfacets, f0: Tensor, rise: Tensor):
        self._facets, self._f0, self._rise = facets, f0, rise
        self._table = coat_table(f0.device)[None]
        self._margin = None if facets.along is None else facets.along - facets.alpha
        self._row = _row(facets.alpha) if facets.along is None else None

    def towards(self, direction: Tensor, cosine: Tensor) -> Tensor:
        """Albedo `[N]` for directions `[3, N]` with the cosine `cosine` `[N]` to the normal."""
        row = _row(self._facets.facing(direction)) if self._row is None else self._row
        albedo = self._lookup(cosine.clamp(0.0, 1.0).sqrt().sqrt() * (2.0 * (COLUMNS - 1) / COLUMNS) - 1.0, row)
        if self._margin is None:
            return albedo
        return albedo + self._margin * (self._f0 * STEEP_MARGIN + self._rise * fifth_power(1.0 - cosine) * GRAZING_MARGIN)

    def mean(self) -> Tensor:
        """Mean albedo `[N]` under uniform illumination; for anisotropic coats, a lower bound of the mean of `towards`."""
        row = _row(self._facets.along) if self._row is None and self._facets.along is not None else self._row
        assert row is not None
        albedo = self._lookup(torch.ones_like(row), row)
        if self._margin is None:
            return albedo
        return albedo + self._margin * (self._f0 * STEEP_MARGIN + self._rise * (GRAZING_MARGIN / 21.0))

    def _lookup(self, column: Tensor, row: Tensor) -> Tensor:
        """Albedo `[N]`, bilinear, at columns and rows `[N]` from -1, the first, to 1, the last."""
        place = torch.stack((column, row), dim=1)[None, None]
        steep, grazing = grid_sample(self._table, place, padding_mode="border", align_corners=True)[0, :, 0]
        return self._f0 * steep + self._rise * grazing


def _row(alpha: Tensor) -> Tensor:
    """Row of α `[N]` in the table, from -1 to 1."""
    lowest = MIN_ALPHA**0.125
    return (alpha.sqrt().sqrt().sqrt() - lowest) * (2.0 / (1.0 - lowest)) - 1.0


def packed_table() -> Tensor:
    """The table for the native core, `[ROWS * WIDTH]` int32: S in the lower 16 bits and B in the upper, in units of 1 / 65535."""
    steep, grazing = (coat_table(torch.device("cpu")) * 65535.0).round().clamp(0.0, 65535.0).long().flatten(1)
    packed = steep + 65536 * grazing
    return torch.where(packed >= 2**31, packed - 2**32, packed).int()
