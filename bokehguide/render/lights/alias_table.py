"""Alias tables: discrete distributions, sampled in constant time (Walker 1977)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor


class AliasTable:
    """Draws indices i with the probability weights[i] / sum(weights). The measure is counting.

    weights: non-negative, `[K]`, at least one positive. starts: `[R + 1]` for R tables in one object: table r chooses among the
    entries from starts[r] to starts[r + 1].
    """

    def __init__(self, weights: np.ndarray, device: torch.device | str = "cpu", starts: np.ndarray | None = None):
        weights = np.asarray(weights, np.float64)
        starts = np.array([0, len(weights)]) if starts is None else np.asarray(starts)
        probability, keep, alias = np.empty_like(weights), np.empty_like(weights), np.empty(len(weights), np.int64)
        for low, high in pairwise(starts.tolist()):
            row = weights[low:high] / weights[low:high].sum()
            probability[low:high] = row
            keep[low:high], columns = _columns(row * len(row))
            alias[low:high] = columns + low
        self.probability = torch.from_numpy(probability.astype(np.float32)).to(device)
        self.keep = torch.from_numpy(keep.astype(np.float32)).to(device)
        self.alias = torch.from_numpy(alias.astype(np.int32)).to(device)
        self.start = torch.from_numpy(starts.astype(np.int32)).to(device)

    def sample(self, uniforms: Tensor, row: Tensor | None = None) -> Tensor:
        """Indices int32 `[N]` from uniform numbers `[2, N]`; row: `[N]`, None for a single table.

        Two numbers have 46 random bits, enough for the column and for the choice in it.
        """
        return _drawn(self.keep, self.alias, None if row is None else (self.start, row), uniforms)

    def pdf(self, index: Tensor) -> Tensor:
        """Probability of each index within its row, float32 `[N]`."""
        return self.probability.index_select(0, index)


def _drawn(keep: Tensor, alias: Tensor, rows: tuple[Tensor, Tensor] | None, uniforms: Tensor) -> Tensor:
    """Entries `[N]` of one table, or of several tables; rows: starts of the tables, and the table of each draw."""
    start, count = 0, keep.shape[0]
    if rows is not None:
        starts, row = rows
        start = starts.index_select(0, row)
        count = starts.index_select(0, row + 1) - start
    position = (uniforms[0].double() + (uniforms[1].double() - 0.5) * 2.0**-23) * count
    slot = position.int()
    stays = (position - slot) < keep.index_select(0, slot + start)
    return torch.where(stays, slot + start, alias.index_select(0, slot + start))


def _columns(scaled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns of height 1 from weights with the mean 1: the share of each entry in its column, and the entry that fills the rest.

    The code is Vose's algorithm in closed form (Hübschle-Schneider and Sanders 2022). Entries below 1 take their deficits from
    the entries above 1, in order. If a heavy entry falls below 1, the next heavy entry fills its column. Cumulative deficits and
    cumulative excesses give the pairs.
    """
    is_heavy = scaled >= min(1.0, scaled.max())  # rounding may put all of equal weights below 1
    light, heavy = np.flatnonzero(~is_heavy), np.flatnonzero(is_heavy)
    deficit, excess = np.cumsum(1.0 - scaled[light]), np.cumsum(scaled[heavy] - 1.0)
    keep, alias = np.ones_like(scaled), np.arange(len(scaled))
    last = len(heavy) - 1
    donors = np.searchsorted(excess, np.concatenate(([0.0], deficit[:-1])))
    keep[light] = scaled[light]
    alias[light] = heavy[np.minimum(donors, last)][: len(light)]
    emptied = np.searchsorted(deficit, excess, side="right")
    topped = np.flatnonzero((emptied < len(light)) & (np.arange(len(heavy)) < last))
    keep[heavy[topped]] = np.clip(1.0 + excess[topped] - deficit[emptied[topped]], 0.0, 1.0)
    alias[heavy[topped]] = heavy[topped + 1]
    return keep, alias
