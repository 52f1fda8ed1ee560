"""Camera tables: f-numbers and focal lengths of a scene file as a thin lens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.scene.apertures import read_aperture
from bokehguide.scene.checks import viewing_direction
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.tables import ANGLE_OF_VIEW, IN_FRONT, NOT_NEGATIVE, POSITIVE, Table
from bokehguide.scene.types import SENSOR_WIDTH, Camera, Vector


@dataclass(frozen=True)
class Focus:
    """What a camera focuses on: the surface at a point of the frame, or a named object.

    place: the key or option that asks for it, for errors. at: pixels from the top left corner, or fractions of the frame if
    both are at most 1. on: the name of an object, of a glTF node or of a material.
    """

    place: str
    at: tuple[float, float] | None = None
    on: str = ""


CAMERA_KEYS = (
    *("position", "target", "up", "fov", "focal_length", "sensor_width"),
    *("aperture_radius", "f_number", "focus_distance", "focus_point", "focus_at", "focus_on", "aperture"),
)
FOCUS_KEYS = ("focus_distance", "focus_point", "focus_at", "focus_on")
"""Keys of which a table has one at most."""


def read_camera(values: dict[str, Any], file: str, files: SceneFiles, shape: dict[str, Any] | None = None) -> Camera:
    """The `[camera]` table of `file` as a Camera.

    files: the files that the table may name. shape: overrides of keys of the aperture's table.

    Raises BokehguideError for unknown keys, values out of range, two keys for one quantity, and a
    viewing direction that is zero or parallel to `up`.
    """
    table = Table(values, file, "camera", CAMERA_KEYS)
    table.exclusive("fov", "focal_length")
    table.exclusive("aperture_radius", "f_number")
    table.exclusive(*FOCUS_KEYS)
    read_focus(table)
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
        aperture=read_aperture(table, files, shape or {}),
        sensor_width=_sensor_width(table),
    )


def read_focus(table: Table) -> Focus | None:
    """The point of the frame or the name under `focus_at` or `focus_on` of a camera's table, None without either."""
    if "focus_on" in table:
        return Focus(table.place("focus_on"), on=table.text("focus_on"))
    if "focus_at" in table:
        return Focus(table.place("focus_at"), at=table.pair("focus_at", NOT_NEGATIVE))
    return None


def focal_length(fov: float, sensor_width: float = SENSOR_WIDTH) -> float:
    """The focal length in millimetres with a field of view of `fov` degrees across `sensor_width` millimetres."""
    return 0.5 * sensor_width / math.tan(math.radians(fov) / 2.0)


def _field_of_view(table: Table) -> float:
    """The horizontal field of view in degrees."""
    if "focal_length" not in table:
        return table.number("fov", Camera.fov, ANGLE_OF_VIEW)
    length, width = table.number("focal_length", None, POSITIVE), _sensor_width(table)
    fov = math.degrees(2.0 * math.atan(width / (2.0 * length)))
    if not ANGLE_OF_VIEW.contains(fov):
        table.fail("focal_length", f"sees {fov:.3g} degrees of a sensor {width:g} mm wide; give {ANGLE_OF_VIEW.remedy}")
    return fov


def _sensor_width(table: Table) -> float:
    """The width of the sensor in millimetres."""
    return table.number("sensor_width", Camera.sensor_width, POSITIVE)


def _aperture_radius(table: Table) -> float:
    """The lens radius in metres, 0 without an aperture key.

    The f-number is focal length / diameter; a table with a field of view has the focal length of that field of view.
    """
    if "f_number" not in table:
        return table.number("aperture_radius", 0.0, NOT_NEGATIVE)
    from_fov = focal_length(table.number("fov", Camera.fov, ANGLE_OF_VIEW), _sensor_width(table))
    length = table.number("focal_length", from_fov, POSITIVE)
    radius = 1e-3 * length / (2.0 * table.number("f_number", None, POSITIVE))
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
