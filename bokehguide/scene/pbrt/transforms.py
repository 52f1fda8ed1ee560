"""Transforms of pbrt as matrices float64 `[4, 4]` that multiply column vectors."""

from __future__ import annotations

import math

import numpy as np

from bokehguide.scene.pbrt.tokens import Place

MIRROR = np.diag((-1.0, 1.0, 1.0, 1.0))
"""The reflection from left-handed to right-handed coordinates. It keeps y and z, one of which is up in most scenes."""


def translation(x: float, y: float, z: float) -> np.ndarray:
    """A translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def rotation(angle: float, x: float, y: float, z: float) -> np.ndarray:
    """A rotation by `angle` degrees about an axis; the identity for the axis 0. Rodrigues' formula."""
    matrix, length = np.eye(4), math.hypot(x, y, z)
    if length > 0.0:
        x, y, z = x / length, y / length, z / length
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
        matrix[:3, :3] += sine * cross + (1.0 - cosine) * (cross @ cross)
    return matrix


def look_at(numbers: list[float], place: Place) -> np.ndarray:
    """The matrix from world to camera space: x to the right, y up, z forward. numbers: eye, target and up.

    Raises BokehguideError where eye and target coincide, or where up is parallel to the direction.
    """
    eye, target, up = np.reshape(numbers, (3, 3))
    forward = target - eye
    right = np.cross(up, forward)
    if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(up) * np.linalg.norm(forward):
        place.fail("LookAt has no direction, or one along its up vector; give another target or up")
    right, forward = right / np.linalg.norm(right), forward / np.linalg.norm(forward)
    matrix = np.eye(4)
    matrix[:3, :3] = right, np.cross(forward, right), forward
    return matrix @ translation(*-eye)


def inverse(matrix: np.ndarray, place: Place, what: str) -> np.ndarray:
    """The inverse. Raises BokehguideError, naming `place` and `what`, for a singular matrix."""
    try:
        inverted = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        inverted = np.full((4, 4), np.nan)
    if not np.isfinite(inverted).all():
        place.fail(f"the transform of {what} is singular; give one with an inverse")
    return inverted


def linear(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A direction `[3]` under `matrix`, as a unit vector; 0 stays 0."""
    moved = matrix[:3, :3] @ vector
    length = np.linalg.norm(moved)
    return moved / length if length > 0.0 else moved
