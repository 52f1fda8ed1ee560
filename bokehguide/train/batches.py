"""Which pixels are rendered together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

BATCH, FIRST_BATCH, SMALL_BATCH = 524288, 131072, 28800
"""Pixels traced together: each thread has as many batches, about as large as memory allows, since Python costs the same for
large ones and small ones. In the first step they are smaller: memory that nobody has used yet takes the system longer to give than
Python costs, and the first picture is waited for. Below the last number Python costs more than another thread brings."""
SHORTEST, LONGEST = 0.5, 1.5
"""Least and most pixels in a batch, but for where it may be cut: of the mean, and of the most there should be."""


class Batches:
    """Cuts a row of pixels into spans of about equal cost, or threads would wait for the one with most to do.

    `spans` cuts it; `cost` is told what the spans cost, and the next are cut by that. It should be what does not change
    from run to run, as rays are and seconds are not.

    paths: of each pixel, about; there are as many times fewer pixels in a batch.
    """

    def __init__(self, threads: int, paths: int = 1):
        self._threads, self._paths = threads, paths
        self._most = FIRST_BATCH // paths
        self._cuts = np.zeros(1)
        """Where spans begin and end, as shares of the row."""
        self._longest = 1.0
        """Most that a span may hold, in units of the mean."""

    def spans(self, pixels: int, ends: np.ndarray | None = None) -> list[slice]:
        """Spans of `pixels` pixels, one behind the other, none of which is empty.

        ends: before which pixels alone they may be cut, ascending, from 0 to `pixels`; None: before any.
        """
        if pixels == 0:
            return []
        rounds = math.ceil(pixels / (self._most * self._threads))
        count = max(min(rounds * self._threads, pixels // SMALL_BATCH), 1)
        if len(self._cuts) != count + 1:  # another size, or spans lost between ends
            self._cuts = np.linspace(0.0, 1.0, count + 1)
        self._longest = LONGEST * self._most * count / pixels
        places = np.rint(self._cuts * pixels).astype(int)
        if ends is not None:
            after = np.searchsorted(ends, places).clip(1)
            before, after = ends[after - 1], ends[after]
            places = np.unique(np.where(places - before < after - places, before, after))
            self._cuts = places / pixels
        places = places.tolist()
        return [slice(first, last) for first, last in zip(places, places[1:])]

    def cost(self, costs: Sequence[float]) -> None:
        """What each of the spans cost, positive."""
        self._most = BATCH // self._paths
        if len(costs) < 2:
            return
        sums, even = np.concatenate(([0.0], np.cumsum(costs))), np.linspace(0.0, 1.0, len(costs) + 1)
        cuts = np.interp(even * sums[-1], sums, self._cuts)
        sizes = np.diff(cuts) * len(costs)
        # Between even spans and these, as near to these as sizes allow.
        reach = min(1.0, (self._longest - 1.0) / max(sizes.max() - 1.0, 1e-9), (1.0 - SHORTEST) / max(1.0 - sizes.min(), 1e-9))
        self._cuts = even + reach * (cuts - even)
