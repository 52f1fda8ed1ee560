"""Directional albedos of anisotropic microfacets, as differences from isotropic ones.

A table holds S and B of `coat_albedo.py` less those of isotropic microfacets with the α towards the direction. The table is 0
without anisotropy. Its axes are the eighth root of α, the strength (KHR_materials_anisotropy), the fourth root of the cosine, and
the place of the fourth root of the α towards the direction between those of both α. Interpolated albedos are too large by 1 %
on average, so that they are upper bounds up to rounding.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.surface import MIN_ALPHA

BRUSHED_TABLE = Path(__file__).with_suffix(".npy")
ALPHAS, STRENGTHS, COSINES, PLACES = 12, 8, 16, 14
"""Sizes of the axes of the table."""
LENGTH = COSINES * PLACES + 1
"""Entries of a pair of α and strength; the last is the difference of the means from that of the larger α."""
LEAST_SPAN = 1e-6
"""Least difference of fourth roots of α as a divisor."""


@cache
def brushed_table(device: torch.device) -> Tensor:
    """Differences of S and B `[2, ALPHAS * STRENGTHS * LENGTH]`, from the file that `scripts/coat_table.py` writes."""
    return torch.from_numpy(np.load(BRUSHED_TABLE)).float().flatten(1).to(device)


def fourth_root(values: Tensor) -> Tensor:
    """Fourth roots of numbers of at least 0, element by element."""
    return values.sqrt().sqrt()


class BrushedAlbedo:
    """Differences of S and B for microfacets of roughness α `alpha`, and `along` in the direction of larger roughness, `[N]`."""

    def __init__(self, alpha: Tensor, along: Tensor):
        self._table = brushed_table(alpha.device)
        lowest = MIN_ALPHA**0.125
        self._low = fourth_root(alpha)
        self._span = fourth_root(along) - self._low
        strength = ((along - alpha) / (1.0 - alpha).clamp(min=LEAST_SPAN)).clamp(0.0, 1.0).sqrt()
        row = (self._low.sqrt() - lowest) * (1.0 / (1.0 - lowest))
        self._start = _corners(_ends(row, ALPHAS), _ends(strength, STRENGTHS), STRENGTHS)

    def towards(self, facing: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
        """Differences `[N]` of S and B at cosines `[N]` for directions with the α `facing` `[N]`."""
        place = (fourth_root(facing) - self._low) / self._span.clamp(min=LEAST_SPAN)
        return self._mixed(_corners(_ends(fourth_root(cosine), COSINES), _ends(place, PLACES), PLACES))

    def mean(self) -> tuple[Tensor, Tensor]:
        """Differences `[N]` of the means of S and B from those of isotropic microfacets of the α `along`."""
        last = torch.full_like(self._start[0][0], LENGTH - 1)
        return self._mixed([(last, torch.ones_like(self._low))])

    def _mixed(self, corners: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
        total = torch.zeros(2, len(self._low), device=self._low.device)
        for start, outer in self._start:
            for place, inner in corners:
                total = total + self._table.index_select(1, start * LENGTH + place) * (outer * inner)
        return total[0], total[1]


def _ends(share: Tensor, size: int) -> list[tuple[Tensor, Tensor]]:
    """Two neighbours on an axis of `size` entries and their weights, for places `[N]` from 0 to 1."""
    place = share.clamp(0.0, 1.0) * float(size - 1)
    lower = place.floor().clamp(max=float(size - 2))
    return [(lower.long(), 1.0 - (place - lower)), (lower.long() + 1, place - lower)]


def _corners(first: list[tuple[Tensor, Tensor]], second: list[tuple[Tensor, Tensor]], size: int) -> list[tuple[Tensor, Tensor]]:
    """Four places and their weights on two axes; size: of the second."""
    return [(i * size + j, u * v) for i, u in first for j, v in second]
