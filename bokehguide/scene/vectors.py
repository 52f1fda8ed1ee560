"""Three numbers as a vector."""

from __future__ import annotations

from collections.abc import Iterable

Vector = tuple[float, float, float]


def as_vector(values: Iterable[float]) -> Vector:
    """Three numbers of any kind as a tuple of floats."""
    x, y, z = map(float, values)
    return x, y, z
