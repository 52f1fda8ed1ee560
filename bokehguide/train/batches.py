"""Which pixels are rendered together, and by which thread's turn."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

BATCH, SMALL_BATCH = 262144, 28800
"""Pixels traced together: each thread has as many batches, as large as memory allows, since Python costs the same for
large ones and small ones. Below the second number it costs more than another thread brings."""
LARGEST = 1.5
"""Most pixels in a batch, in units of the mean."""


class Batches:
    """Cuts a row of pixels into spans that take about equally long, or threads would wait for the one with most to do.

    `spans` cuts them as they took last time, even at first; `took` is told how long each one did.
    """

    def __init__(self, threads: int):
        self._threads = threads
        self._cuts = np.zeros(1)
        """Where spans begin and end, as shares of the row."""

    def spans(self, pixels: int) -> list[slice]:
        """Spans of `pixels` pixels, one behind the other, none of which is empty."""
        if pixels == 0:
            return []
        rounds = math.ceil(pixels / (BATCH * self._threads))
        count = max(min(rounds * self._threads, pixels // SMALL_BATCH), 1)
        if len(self._cuts) != count + 1:
            self._cuts = np.linspace(0.0, 1.0, count + 1)
        places = np.rint(self._cuts * pixels).astype(int).tolist()
        return [slice(first, last) for first, last in zip(places, places[1:])]

    def took(self, seconds: Sequence[float]) -> None:
        """Seconds that each of the spans took."""
        if not seconds:
            return
        passed = np.concatenate(([0.0], np.cumsum(seconds)))
        even = np.interp(np.linspace(0.0, passed[-1], len(passed)), passed, self._cuts)
        cuts = 0.5 * (self._cuts + even)  # one step may be slow for other reasons
        if np.diff(cuts).max() * len(seconds) <= LARGEST:
            self._cuts = cuts
