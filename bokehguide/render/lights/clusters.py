"""Clusters of lights, and tables with the probabilities of clusters."""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

LEVELS = 7
"""Binary logarithm of the largest number of clusters of one kind of light."""


class ClusterTable:
    """A choice among C clusters in each of R rows; the measure is counting. Kernels take it as an argument.

    probability: float64 `[R, C]`; rows sum to 1.
    """

    def __init__(self, probability: Tensor):
        count = probability.shape[1]
        self.levels = max((count - 1).bit_length(), 1)
        cumulative = probability.cumsum(1).float().clamp(max=1.0)
        cumulative[:, -1] = 1.0
        cumulative = pad(cumulative, (0, 2**self.levels - count), value=1.0)
        self._probability = torch.diff(cumulative, dim=1, prepend=torch.zeros_like(cumulative[:, :1])).reshape(-1)
        self.cumulative = cumulative.reshape(-1)

    def sample(self, row: Tensor, uniforms: Tensor) -> Tensor:
        """Clusters int32 `[N]` for rows int32 `[N]` from uniform numbers `[N]`: the first cluster whose cumulative probability
        exceeds the uniform number."""
        base = (row << self.levels) - 1
        place = base  # of the last cluster known to lie below
        for level in reversed(range(self.levels)):
            place = place + ((self.cumulative.index_select(0, place + (1 << level)) <= uniforms).int() << level)
        return place - base

    def pdf(self, row: Tensor, cluster: Tensor) -> Tensor:
        """Probability of each cluster in each row, `[N]`."""
        return self._probability.index_select(0, (row << self.levels) + cluster)


def build_clusters(features: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, int]:
    """Cluster of each light, int64 `[K]`, and the number of clusters, by repeated bisection of the cluster with the largest
    spread.

    The spread is the power times the diagonal of the bounding box of the features.

    features: `[K, F]`; similar lights have similar features. power: `[K]`.
    """
    columns = np.ascontiguousarray(features.T)
    groups = {0: _Group.of(np.arange(len(power)), columns, power)}
    queue = [(-groups[0].spread, 0)]
    while queue and len(groups) < 2**LEVELS:
        _, name = heapq.heappop(queue)
        members, low, high, _ = groups[name]
        axis = int(np.argmax(high - low))
        upper = columns[axis, members] > 0.5 * (low[axis] + high[axis])
        if not upper.any() or upper.all():
            continue
        for half, kept in ((name, ~upper), (len(groups), upper)):
            groups[half] = _Group.of(members[kept], columns, power)
            heapq.heappush(queue, (-groups[half].spread, half))
    cluster = np.empty(len(power), np.int64)
    for name, group in groups.items():
        cluster[group.members] = name
    return cluster, len(groups)


class _Group(NamedTuple):
    """Lights `members` `[M]`, the bounding box `low` and `high` `[F]` of their features, and the spread."""

    members: np.ndarray
    low: np.ndarray
    high: np.ndarray
    spread: float

    @classmethod
    def of(cls, members: np.ndarray, columns: np.ndarray, power: np.ndarray) -> _Group:
        """columns: features, `[F, K]`, which NumPy reduces much faster than `[K, F]`. power: `[K]`."""
        points = columns[:, members]
        low, high = points.min(axis=1), points.max(axis=1)
        return cls(members, low, high, float(power[members].sum()) * float(np.linalg.norm(high - low)))
