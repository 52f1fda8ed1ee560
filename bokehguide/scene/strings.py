"""Points at equal distances along a string that hangs between supports."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Protocol

import numpy as np

FLATTEST = 1e-6
"""A span that hangs by less than this share of its width is straight."""
STEEPEST = 1e-6
"""A hanging span is at least this wide, relative to its height and its sag."""


class Span(Protocol):
    """The string between two supports. length: metres along the string."""

    length: float

    def at(self, arc: np.ndarray) -> np.ndarray:
        """Points `[N, 3]` at the lengths `[N]` along the string from its start."""
        ...


class Line:
    """A straight span from `start` to `end`, both `[3]`."""

    def __init__(self, start: np.ndarray, end: np.ndarray):
        self._start, self._end = start, end
        self.length = float(np.linalg.norm(end - start))

    def at(self, arc: np.ndarray) -> np.ndarray:
        """See `Span`."""
        return self._start + (arc / self.length)[:, None] * (self._end - self._start)


class Catenary:
    """A span from `start` to `end`, both `[3]`, whose middle hangs `sag` metres below the straight line between them.

    With x across, the height is y(x) = a (cosh((x - x0) / a) - cosh(x0 / a)). Half the width over a, t, follows from the sag:
    sag² = (w (cosh t - 1) / 2t)² + (h tanh(t / 2) / 2)², with the width w and the difference h of the heights of the ends.
    The right side grows with t. The arc length is a (sinh((x - x0) / a) + sinh(x0 / a)).
    """

    def __init__(self, start: np.ndarray, end: np.ndarray, sag: float):
        from scipy.optimize import brentq  # takes a fifth of a second to import

        across = np.array([end[0] - start[0], 0.0, end[2] - start[2]])
        self._start, width, rise = start, float(np.linalg.norm(across)), float(end[1] - start[1])
        self._across = across / width

        def excess(t: float) -> float:
            return math.hypot(width * math.sinh(t / 2.0) ** 2 / t, 0.5 * rise * math.tanh(t / 2.0)) - sag

        t = float(brentq(excess, 1e-9, 100.0, xtol=1e-15))  # type: ignore[arg-type]
        self._a = width / (2.0 * t)
        self._first = math.asinh(rise / (2.0 * self._a * math.sinh(t))) - t
        """(x - x0) / a at the start."""
        self.length = self._a * (math.sinh(self._first + 2.0 * t) - math.sinh(self._first))

    def at(self, arc: np.ndarray) -> np.ndarray:
        """See `Span`."""
        last = np.arcsinh(arc / self._a + math.sinh(self._first))
        x = self._a * (last - self._first)
        y = 2.0 * self._a * np.sinh(0.5 * (last + self._first)) * np.sinh(0.5 * (last - self._first))
        return self._start + x[:, None] * self._across + y[:, None] * np.array([0.0, 1.0, 0.0])


class String:
    """A string over `supports` `[K, 3]`, K of 2 or more, whose spans are catenaries of one `sag` in metres, or straight for 0.

    Raises ValueError for supports on one point, and for a hanging span that is too steep.
    """

    def __init__(self, supports: np.ndarray, sag: float = 0.0):
        self._spans = [_span(start, end, sag) for start, end in pairwise(supports)]
        self._ends = np.cumsum([span.length for span in self._spans])

    def count(self, spacing: float) -> float:
        """The number of points that `points` returns."""
        return math.floor(self._ends[-1] / spacing * (1.0 + 1e-9)) + 1.0

    def points(self, spacing: float) -> np.ndarray:
        """Points `[N, 3]` from the first support on, `spacing` metres apart along the string."""
        arc = spacing * np.arange(self.count(spacing))
        owner = np.minimum(np.searchsorted(self._ends, arc), len(self._spans) - 1)
        starts = np.concatenate([[0.0], self._ends[:-1]])
        parts = [span.at(arc[owner == number] - starts[number]) for number, span in enumerate(self._spans)]
        return np.concatenate(parts)


def _span(start: np.ndarray, end: np.ndarray, sag: float) -> Span:
    width, height = math.hypot(end[0] - start[0], end[2] - start[2]), abs(end[1] - start[1])
    if math.hypot(width, height) == 0.0:
        raise ValueError("two neighbouring supports are one point")
    if sag <= FLATTEST * width:
        return Line(start, end)
    if width < STEEPEST * (height + sag):
        raise ValueError("a span stands upright, so it cannot hang")
    return Catenary(start, end, sag)
