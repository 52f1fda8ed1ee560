"""Batches: spans of pixels that are rendered together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

BATCH = 131072
"""Largest number of pixels of a batch on a CPU. The overhead of a larger batch is too small to measure."""
OVERHEAD = 400
"""Pixels whose work on a CPU takes as long as the overhead of a batch, in `lis-o` (160 in `uniform` and `guided`).

The overhead holds the interpreter's lock. Therefore the overheads of all batches together should not take longer than one batch:
pixels / n = n · OVERHEAD for n batches."""
GPU_BATCH, SMALL_GPU_BATCH = 1048576, 131072
"""Largest and smallest number of pixels of a batch on a GPU with enough memory. Each operation of a batch is a kernel launch."""
GPU_THREADS = 2
"""Threads that launch kernels on a GPU: one launches while the other traces rays. More would wait for the interpreter."""
PATH_BYTES, GPU_SHARE = 8192, 0.5
"""Memory of a path on a GPU, and the share of the free memory that all batches may take."""
SHORTEST, LONGEST = 0.5, 1.5
"""Least size of a span over the mean size, and largest size over the intended size, before bounds move to allowed cuts."""
NEWEST = 0.5
"""Weight of the last step's seconds in the bounds of the next step; the other part is that of earlier steps. Another process may
delay a batch of one step."""


class Batches:
    """Cuts a row of pixels into spans that take about equally long, so that no thread waits for another.

    `spans` cuts the row by the seconds that `took` has received for the earlier spans. Numbers of rays would leave out the work
    on candidates and on reused hits.

    paths: approximate number of paths of a pixel. The largest number of pixels is divided by this number. smallest: number of
    pixels of a batch, at least, if there are several; None: by OVERHEAD.
    """

    def __init__(self, threads: int, paths: int = 1, smallest: int | None = None, largest: int = BATCH):
        self._threads, self._smallest = threads, smallest
        self._most = largest // paths
        self._wanted = self._cuts = np.zeros(1)
        """Bounds of the spans as fractions of the row: best bounds, and the bounds of the last spans at allowed places."""
        self._longest = 1.0
        """Largest size of a span over the mean."""

    @classmethod
    def on_gpu(cls, free: float, paths: int = 1) -> Batches:
        """Batches for GPU_THREADS threads and a GPU with `free` bytes of memory."""
        largest = int(min(GPU_BATCH, GPU_SHARE * free / (GPU_THREADS * PATH_BYTES)))
        return cls(GPU_THREADS, paths, min(SMALL_GPU_BATCH, largest // (2 * paths)), largest)

    def spans(self, pixels: int, ends: np.ndarray | None = None) -> list[slice]:
        """Consecutive spans of `pixels` pixels, none of them empty.

        ends: allowed bounds of spans, ascending, from 0 to `pixels`; None: all.
        """
        if pixels == 0:
            return []
        rounds = math.ceil(pixels / (self._most * self._threads))
        count = rounds * self._threads  # all threads have equally many
        if rounds == 1:
            count = max(min(count, int(pixels / (self._smallest or math.sqrt(OVERHEAD * pixels)))), 1)
        if len(self._wanted) != count + 1:  # another size
            self._wanted = np.linspace(0.0, 1.0, count + 1)
        self._longest = LONGEST * self._most * count / pixels
        bounds = np.rint(self._wanted * pixels).astype(int)
        if ends is not None:
            bounds = _at_ends(bounds, ends)
        self._cuts = bounds / pixels
        return [slice(first, last) for first, last in pairwise(bounds.tolist())]

    def took(self, seconds: Sequence[float]) -> None:
        """Set the seconds of the last spans, positive."""
        if len(seconds) < 2:
            return
        sums, even = np.concatenate(([0.0], np.cumsum(seconds))), np.linspace(0.0, 1.0, len(self._wanted))
        cuts = np.interp(even * sums[-1], sums, self._cuts)
        sizes = np.diff(cuts) * (len(cuts) - 1)
        # Interpolate from even spans to these, as far as the sizes allow.
        reach = min(1.0, (self._longest - 1.0) / max(sizes.max() - 1.0, 1e-9), (1.0 - SHORTEST) / max(1.0 - sizes.min(), 1e-9))
        self._wanted += NEWEST * (even + reach * (cuts - even) - self._wanted)


def _at_ends(bounds: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """The nearest allowed bounds. No two are equal, so that no thread is without a batch; fewer only if there are fewer ends."""
    last, numbers = len(ends) - 1, np.arange(len(bounds))
    if last < len(bounds):
        return ends
    after = np.searchsorted(ends, bounds).clip(1)
    place = np.where(bounds - ends[after - 1] < ends[after] - bounds, after - 1, after)
    place = np.maximum.accumulate(place - numbers) + numbers
    return ends[np.minimum(place, last - numbers[::-1])]
