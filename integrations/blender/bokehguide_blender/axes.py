"""Axes of Blender (z up) and of scene files (y up). Needs no Blender."""

from __future__ import annotations

from collections.abc import Sequence

Vector = tuple[float, float, float]
Matrix = Sequence[Sequence[float]]


def y_up(vector: Sequence[float]) -> Vector:
    """A position or direction of Blender in the axes of scene files and glTF."""
    x, y, z = vector
    return float(x), float(z), -float(y)


def column(matrix: Matrix, index: int) -> Vector:
    """A column of a 4 × 4 matrix, without its last element: axes 0 to 2, and the position 3."""
    return float(matrix[0][index]), float(matrix[1][index]), float(matrix[2][index])


def length(vector: Sequence[float]) -> float:
    return sum(each * each for each in vector) ** 0.5


def scaled(vector: Sequence[float], factor: float) -> Vector:
    x, y, z = vector
    return x * factor, y * factor, z * factor


def unit(vector: Sequence[float]) -> Vector:
    """The direction of a vector, which is not 0."""
    return scaled(vector, 1.0 / length(vector))


def forward(matrix: Matrix) -> Vector:
    """The direction in which a camera or a light looks: -z of its 4 × 4 matrix, of length 1."""
    return scaled(unit(column(matrix, 2)), -1.0)


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b))
