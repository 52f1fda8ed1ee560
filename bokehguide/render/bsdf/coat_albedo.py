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

from bokehguide.render.bsdf.brushed_albedo import BrushedAlbedo, brushed_table, fourth_root
from bokehguide.render.bsdf.microfacets import Microfacets
from bokehguide.render.surface import MIN_ALPHA

TABLE = Path(__file__).with_suffix(".npy")
ROWS, COLUMNS = 64, 96
"""Size of the table: rows over the eighth root of α, from `MIN_ALPHA` to 1, and columns over the fourth root of the cosine."""
WIDTH = COLUMNS + 1
"""Columns of the table with the last one, which has the cosine-weighted mean of its row."""


@cache
def coat_table(device: torch.device) -> Tensor:
    """S and B `[2, ROWS, WIDTH]`, from the file that `scripts/coat_table.py` writes."""
    return torch.from_numpy(np.load(TABLE)).to(device)


class CoatAlbedo:
    """Albedo of coats over `facets`, with Schlick's reflectance f0 + rise (1 - cos θ)⁵; f0, rise: `[N]`.

    Those of anisotropic coats differ from those of isotropic ones by `brushed_albedo.py`.
    """

    def __init__(self, facets: Microfacets, f0: Tensor, rise: Tensor):
        self._facets, self._f0, self._rise = facets, f0, rise
        self._table = coat_table(f0.device)[None]
        self._brushed = None if facets.along is None else BrushedAlbedo(facets.alpha, facets.along)
        self._row = _row(facets.alpha) if facets.along is None else None

    def towards(self, direction: Tensor, cosine: Tensor) -> Tensor:
        """Albedo `[N]` for directions `[3, N]` with the cosine `cosine` `[N]` to the normal."""
        cosine, facing = cosine.clamp(0.0, 1.0), self._facets.facing(direction)
        row = _row(facing) if self._row is None else self._row
        albedo = self._lookup(fourth_root(cosine) * (2.0 * (COLUMNS - 1) / COLUMNS) - 1.0, row)
        return albedo if self._brushed is None else albedo + self._mixed(*self._brushed.towards(facing, cosine))

    def mean(self) -> Tensor:
        """Mean albedo `[N]` under uniform illumination."""
        row = _row(self._facets.along) if self._row is None and self._facets.along is not None else self._row
        assert row is not None
        albedo = self._lookup(torch.ones_like(row), row)
        return albedo if self._brushed is None else albedo + self._mixed(*self._brushed.mean())

    def _mixed(self, steep: Tensor, grazing: Tensor) -> Tensor:
        return self._f0 * steep + self._rise * grazing

    def _lookup(self, column: Tensor, row: Tensor) -> Tensor:
        """Albedo `[N]`, bilinear, at columns and rows `[N]` from -1, the first, to 1, the last."""
        place = torch.stack((column, row), dim=1)[None, None]
        steep, grazing = grid_sample(self._table, place, padding_mode="border", align_corners=True)[0, :, 0]
        return self._mixed(steep, grazing)


def _row(alpha: Tensor) -> Tensor:
    """Row of α `[N]` in the table, from -1 to 1."""
    lowest = MIN_ALPHA**0.125
    return (alpha.sqrt().sqrt().sqrt() - lowest) * (2.0 / (1.0 - lowest)) - 1.0


def packed_table() -> Tensor:
    """The table for the native core, `[ROWS * WIDTH]` int32: S in the lower 16 bits and B in the upper, in units of 1 / 65535."""
    return _packed(coat_table(torch.device("cpu")) * 65535.0)


def packed_brushed_table() -> Tensor:
    """The table of anisotropic microfacets for the native core, int32 `[N]`, packed likewise; 32768 stands for 0."""
    return _packed(brushed_table(torch.device("cpu")) * 65535.0 + 32768.0)


def _packed(values: Tensor) -> Tensor:
    """Pairs of numbers `[2, ...]` from 0 to 65535 as int32 `[N]`."""
    lower, upper = values.round().clamp(0.0, 65535.0).long().flatten(1)
    packed = lower + 65536 * upper
    return torch.where(packed >= 2**31, packed - 2**32, packed).int()
