"""Three numbers as a vector."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

Vector = tuple[float, float, float]


def as_vector(values: Iterable[float]) -> Vector:
    """Three numbers of any kind as a tuple of floats."""
    x, y, z = map(float, values)
    return x, y, z


def fractions(color: Any) -> Vector:
    """A colour within 0 and 1."""
    return as_vector(min(max(float(channel), 0.0), 1.0) for channel in color)
