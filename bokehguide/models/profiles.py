"""Densities along rows and columns of a bilinear map: straight lines between the weights at whole positions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


class Profiles:
    """Piecewise linear densities on circles of `period` positions, of G groups.

    group, position: int64 `[K]`, no pair twice; weight: `[K]`, at these positions, 0 at all others. Sums of a group go on
    beyond the period by its `total` each turn.
    """

    def __init__(self, groups: int, group: np.ndarray, position: np.ndarray, weight: np.ndarray, period: int, device: torch.device):
        size = period + 1  # position 0 stands at both ends of a turn
        first = np.arange(groups) * size
        beside = [group * size + (position + step) % period for step in (-1, 0, 1)]
        keys = np.unique(np.concatenate((*beside, first, first + period)))
        weights, start, end = np.zeros(len(keys)), np.searchsorted(keys, first), np.searchsorted(keys, first + period)
        weights[np.searchsorted(keys, group * size + position)] = weight
        weights[end] = weights[start]
        mass = 0.5 * (weights[:-1] + weights[1:])
        mass[end[:-1]] = 0.0  # no line leads from one group to the next
        below = np.append(0.0, np.cumsum(mass))
        self.period, self.position = period, torch.from_numpy(keys % size).to(device)
        """Positions of the knots that lines lead between, `[knots]`: those of all weights, and their neighbours."""
        self._keys, self._weights = torch.from_numpy(keys).to(device), torch.from_numpy(np.append(weights, 0.0)).to(device)
        self._start, self._end = torch.from_numpy(start).to(device), torch.from_numpy(end).to(device)
        self._below = torch.from_numpy(below).to(device)
        self.total = self._below[self._end] - self._below[self._start]
        """Sum of each group's weights, float64 `[G]`."""

    def find(self, group: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """The knots before places `x` of groups, both `[N]`, and how far `x` lies beyond them."""
        x = x - (x / self.period).floor() * self.period
        key = group * (self.period + 1) + x.floor().long()
        knot = torch.searchsorted(self._keys, key, right=True) - 1
        return knot, x - self.position.index_select(0, knot)

    def below(self, group: Tensor, x: Tensor) -> Tensor:
        """Integrals `[N]` of groups' densities from 0 to places `x`, float64 `[N]`."""
        turns = (x / self.period).floor()
        knot, beyond = self.find(group, x)
        start, end = self._weights.index_select(0, knot), self._weights.index_select(0, knot + 1)
        before = self._below.index_select(0, knot) - self._below.index_select(0, self._start.index_select(0, group))
        return before + (start + 0.5 * (end - start) * beyond) * beyond + turns * self.total.index_select(0, group)

    def place(self, group: Tensor, below: Tensor) -> Tensor:
        """The inverse of `below`, float64 `[N]`; anything for groups without weights."""
        first, total = self._start.index_select(0, group), self.total.index_select(0, group).clamp(min=1e-300)
        turns = (below / total).floor()
        target = below - turns * total + self._below.index_select(0, first)
        knot = torch.searchsorted(self._below, target, right=True) - 1
        knot = torch.minimum(torch.maximum(knot, first), self._end.index_select(0, group) - 1)
        start, end = self._weights.index_select(0, knot), self._weights.index_select(0, knot + 1)
        rest = (target - self._below.index_select(0, knot)).clamp(min=0.0)
        root = (start * start + 2.0 * (end - start) * rest).clamp(min=0.0).sqrt()
        beyond = (2.0 * rest / (start + root).clamp(min=1e-300)).clamp(max=1.0)
        return self.position.index_select(0, knot) + beyond + turns * self.period
