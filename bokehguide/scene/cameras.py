"""Camera tables: f-numbers and focal lengths of a scene file as a thin lens."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bokehguide.scene.apertures import read_aperture
from bokehguide.scene.checks import viewing_direction
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.tables import ANGLE_OF_VIEW, IN_FRONT, NOT_NEGATIVE, POSITIVE, Table
from bokehguide.scene.types import Camera, Vector

SENSOR_WIDTH = 36.0
"""Millimetres; the default sensor for focal lengths and f-numbers."""

CAMERA_KEYS = (
    *("position", "target", "up", "fov", "focal_length", "sensor_width"),
    *("aperture_radius", "f_number", "focus_distance", "focus_point", "aperture"),
)


def read_camera(values: dict[str, Any], file: str, files: SceneFiles) -> Camera:
    """The `[camera]` table of `file` as a Camera. files: the files that the table may name.

    Raises BokehguideError for unknown keys, values out of range, two keys for one quantity, and a
    viewing direction that is zero or parallel to `up`.
    """
    table = Table(values, file, "camera", CAMERA_KEYS)
    table.exclusive("fov", "focal_length")
    table.exclusive("aperture_radius", "f_number")
    table.exclusive("focus_distance", "focus_point")
    for key in ("position", "target"):
        if key not in table:
            table.missing(key, "give [x, y, z] in metres")
    position = table.vector("position", None)
    target = table.vector("target", None)
    up = table.vector("up", (0.0, 1.0, 0.0))
    forward = viewing_direction(table, position, target, up)
    return Camera(
        position=position,
        target=target,
        up=up,
        fov=_field_of_view(table),
        aperture_radius=_aperture_radius(table),
        focus_distance=_focus_distance(table, position, target, forward),
        aperture=read_aperture(table, files),
    )


def focal_length(fov: float, sensor_width: float = SENSOR_WIDTH) -> float:
    """The focal length in millimetres with a field of view of `fov` degrees across `sensor_width` millimetres."""
    return 0.5 * sensor_width / math.tan(math.radians(fov) / 2.0)


def _field_of_view(table: Table) -> float:
    """The horizontal field of view in degrees."""
    if "focal_length" not in table:
        if "sensor_width" in table:
            table.fail("sensor_width", "has no focal_length beside it; give both, or fov")
        return table.number("fov", Camera.fov, ANGLE_OF_VIEW)
    length = table.number("focal_length", None, POSITIVE)
    width = table.number("sensor_width", SENSOR_WIDTH, POSITIVE)
    fov = math.degrees(2.0 * math.atan(width / (2.0 * length)))
    if not ANGLE_OF_VIEW.contains(fov):
        table.fail("focal_length", f"sees {fov:.3g} degrees of a sensor {width:g} mm wide; give {ANGLE_OF_VIEW.remedy}")
    return fov


def _aperture_radius(table: Table) -> float:
    """The lens radius in metres, 0 without an aperture key."""
    if "f_number" not in table:
        return table.number("aperture_radius", 0.0, NOT_NEGATIVE)
    if "focal_length" not in table:
        table.fail("f_number", "needs a focal_length (mm); give one, or give aperture_radius (m)")
    f_number = table.number("f_number", None, POSITIVE)
    radius = 1e-3 * table.number("focal_length", None, POSITIVE) / (2.0 * f_number)
    if not NOT_NEGATIVE.contains(radius):
        table.fail("f_number", f"makes a lens of radius {radius:g} m; give a larger one")
    return radius


def _focus_distance(table: Table, position: Vector, target: Vector, forward: np.ndarray) -> float:
    """The focus distance in metres along the optical axis. The default is the target's."""
    if "focus_point" not in table:
        distance = max(float(np.linalg.norm(np.subtract(target, position))), IN_FRONT.low)
        return table.number("focus_distance", distance, IN_FRONT)
    point = table.vector("focus_point", None)
    distance = float(np.subtract(point, position) @ forward)
    if not IN_FRONT.contains(distance):
        table.fail("focus_point", "lies behind the lens; give a point in front of the camera")
    return distance
