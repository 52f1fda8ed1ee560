"""Seconds by phase, of one thread."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager


class PhaseTimer:
    """Sums of seconds by phase. The time of a nested phase is not part of the outer phase."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self._nested = [0.0]
        """Seconds of nested phases, for each open phase."""

    def add(self, phase: str, seconds: float) -> None:
        """Seconds of `phase` that were measured elsewhere, within the open phase."""
        self.seconds[phase] += seconds  # pyright: ignore[reportArgumentType]
        self._nested[-1] += seconds

    @contextmanager
    def measure(self, phase: str) -> Iterator[None]:
        """A context that adds its seconds to `phase`."""
        start = time.perf_counter()
        self._nested.append(0.0)
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[phase] += elapsed - self._nested.pop()  # pyright: ignore[reportArgumentType]
            self._nested[-1] += elapsed
