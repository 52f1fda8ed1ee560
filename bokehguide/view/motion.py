"""Movements of the camera by the pointer and by keys. No movement adds a roll: `up` stays up in the frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.sight import camera_axes
from bokehguide.scene.tables import did_you_mean
from bokehguide.scene.types import Camera, Vector, as_vector

TURN = np.radians(180.0)
"""Angle by which a drag across the whole frame turns."""
STEEPEST = np.radians(87.0)
"""Largest elevation of the optical axis. A camera that looks along `up` would have no right side."""

Place = tuple[Vector, Vector]
"""Position and target of a camera."""


def move(camera: Camera, kind: str, x: float, y: float) -> Place:
    """Position and target after a movement.

    kind: a name in MOVEMENTS. x, y: of the drag to the right and down, as fractions of the width of the frame. Raises
    BokehguideError for an unknown kind.
    """
    if kind not in MOVEMENTS:
        raise BokehguideError(f"move: {kind[:40]!r} is no movement; {did_you_mean(kind, MOVEMENTS)}")
    return MOVEMENTS[kind](camera, x, y)


def orbit(camera: Camera, x: float, y: float) -> Place:
    """Turn about the target."""
    forward = _turned(camera, -x * TURN, -y * TURN)
    position = np.array(camera.target) - _distance(camera) * forward
    return as_vector(position), camera.target


def look(camera: Camera, x: float, y: float) -> Place:
    """Turn about the position, so that the picture follows the pointer."""
    across = np.radians(camera.fov)
    forward = _turned(camera, x * across, y * across)
    return camera.position, as_vector(np.array(camera.position) + _distance(camera) * forward)


def pan(camera: Camera, x: float, y: float) -> Place:
    """Shift parallel to the frame, so that the target follows the pointer."""
    width = 2.0 * _distance(camera) * np.tan(np.radians(camera.fov) / 2.0)
    right, up, _ = camera_axes(camera)
    return _shifted(camera, width * (y * up - x * right))


def dolly(camera: Camera, x: float, y: float) -> Place:
    """Go towards the target by an upward drag; a drag by half of the frame's width halves the distance."""
    position, target = np.array(camera.position), np.array(camera.target)
    return as_vector(target + (position - target) * 4.0 ** np.clip(y, -2.0, 2.0)), camera.target


def walk(camera: Camera, x: float, y: float) -> Place:
    """Go to the right by x and back by y, on a plane across `up`, in distances of the target."""
    right, _, forward = camera_axes(camera)
    up = np.array(camera.up) / np.linalg.norm(camera.up)
    level = forward - (forward @ up) * up
    return _shifted(camera, _distance(camera) * (x * right - y * level / np.linalg.norm(level)))


def rise(camera: Camera, x: float, y: float) -> Place:
    """Go down along `up` by y, in distances of the target."""
    up = np.array(camera.up) / np.linalg.norm(camera.up)
    return _shifted(camera, -y * _distance(camera) * up)


MOVEMENTS: dict[str, Callable[[Camera, float, float], Place]] = {
    "orbit": orbit,
    "look": look,
    "pan": pan,
    "dolly": dolly,
    "walk": walk,
    "rise": rise,
}


def _distance(camera: Camera) -> float:
    return float(np.linalg.norm(np.subtract(camera.target, camera.position)))


def _shifted(camera: Camera, shift: np.ndarray) -> Place:
    return as_vector(np.array(camera.position) + shift), as_vector(np.array(camera.target) + shift)


def _turned(camera: Camera, azimuth: float, elevation: float) -> np.ndarray:
    """The optical axis, turned about `up` to the left by `azimuth` and upwards by `elevation`, radians; a unit vector."""
    right, _, forward = camera_axes(camera)
    up = np.array(camera.up) / np.linalg.norm(camera.up)
    level = np.cross(up, right)
    height = np.clip(np.arcsin(np.clip(forward @ up, -1.0, 1.0)) + elevation, -STEEPEST, STEEPEST)
    level = np.cos(azimuth) * level - np.sin(azimuth) * right
    return np.cos(height) * level + np.sin(height) * up
