"""Piecewise linear densities along rows and columns of a bilinear map, given by their values at integer positions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

TINY = 1e-300
"""Least divisor, for groups without weights."""


class PiecewiseLinear:
    """G periodic, piecewise linear densities, one for each group, with `period` positions.

    group, position: int64 `[K]`, without duplicate pairs. weight: unnormalised densities at these positions, `[K]`. The densities
    are 0 at all other integer positions.
    """

    def __init__(
        self, groups: int, group: np.ndarray, position: np.ndarray, weight: np.ndarray, period: int, device: torch.device
    ):
        size = period + 1  # position 0 has a knot at both ends of a turn
        first = np.arange(groups) * size
        neighbours = [group * size + (position + step) % period for step in (-1, 0, 1)]
        keys = np.unique(np.concatenate((*neighbours, first, first + period)))
        weights, start, end = np.zeros(len(keys)), np.searchsorted(keys, first), np.searchsorted(keys, first + period)
        weights[np.searchsorted(keys, group * size + position)] = weight
        weights[end] = weights[start]
        mass = 0.5 * (weights[:-1] + weights[1:])
        mass[end[:-1]] = 0.0  # between the last knot of a group and the first of the next
        cumulative = np.append(0.0, np.cumsum(mass))
        self.period, self.position = period, torch.from_numpy(keys % size).to(device)
        """Positions of the knots, `[knots]`: all positions with weights, and their neighbours."""
        self._keys, self._weights = torch.from_numpy(keys).to(device), torch.from_numpy(np.append(weights, 0.0)).to(device)
        self._start, self._end = torch.from_numpy(start).to(device), torch.from_numpy(end).to(device)
        self._cumulative = torch.from_numpy(cumulative).to(device)
        self.total = self._cumulative[self._end] - self._cumulative[self._start]
        """Integral of each density over its period, float64 `[G]`."""

    def tables(self) -> dict[str, Tensor]:
        """Tables of the knots, `[knots]`, and of the groups, `[G]`, by the names of `PiecewiseTable` in `native/tables.h`."""
        tables = {"keys": self._keys, "position": self.position, "start": self._start, "end": self._end}
        return tables | {"weights": self._weights, "cumulative": self._cumulative, "total": self.total}

    def find(self, group: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """The last knot at or before the positions `x` of groups, both `[N]`, and the distance from the knot to `x`."""
        x = x - (x / self.period).floor() * self.period
        key = group * (self.period + 1) + x.floor().long()
        knot = torch.searchsorted(self._keys, key, right=True) - 1
        return knot, x - self.position.index_select(0, knot)

    def integral(self, group: Tensor, x: Tensor) -> Tensor:
        """Integrals of the groups' densities from 0 to `x`, float64 `[N]`. `x` may exceed the period."""
        turns = (x / self.period).floor()
        knot, distance = self.find(group, x)
        start, end = self._weights.index_select(0, knot), self._weights.index_select(0, knot + 1)
        before = self._cumulative.index_select(0, knot) - self._cumulative.index_select(0, self._start.index_select(0, group))
        return before + (start + 0.5 * (end - start) * distance) * distance + turns * self.total.index_select(0, group)

    def inverse(self, group: Tensor, integral: Tensor) -> Tensor:
        """Positions at which `integral` has the given values, float64 `[N]`; arbitrary for groups without weights.

        Between knots of weights a and b, the integral over a distance t is m = a t + (b - a) t² / 2.
        The inverse is t = 2 m / (a + √(a² + 2 (b - a) m)).
        """
        first, total = self._start.index_select(0, group), self.total.index_select(0, group).clamp(min=TINY)
        turns = (integral / total).floor()
        target = integral - turns * total + self._cumulative.index_select(0, first)
        knot = torch.searchsorted(self._cumulative, target, right=True) - 1
        knot = torch.minimum(torch.maximum(knot, first), self._end.index_select(0, group) - 1)
        start, end = self._weights.index_select(0, knot), self._weights.index_select(0, knot + 1)
        rest = (target - self._cumulative.index_select(0, knot)).clamp(min=0.0)
        root = (start * start + 2.0 * (end - start) * rest).clamp(min=0.0).sqrt()
        distance = (2.0 * rest / (start + root).clamp(min=TINY)).clamp(max=1.0)
        return self.position.index_select(0, knot) + distance + turns * self.period
