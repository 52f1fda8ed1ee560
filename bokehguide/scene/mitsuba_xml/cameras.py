"""The sensor, the film and the depth of the integrator of Mitsuba."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bokehguide.scene.mitsuba_xml.materials import Materials
from bokehguide.scene.mitsuba_xml.tree import Plugin
from bokehguide.scene.types import FilmSettings

SENSORS = ("thinlens", "perspective")
UNBOUNDED = 64
"""Segments of the longest path of an integrator without a limit; Russian roulette ends nearly all paths before."""


def read_film(sensor: Plugin, root: Plugin, materials: Materials) -> FilmSettings:
    """Size of the film, and the depth of the integrator."""
    films = sensor.inner("film")
    film = films[0] if films else sensor
    width, height = (int(film.number(key, size)) if films else size for key, size in (("width", 768), ("height", 576)))
    whole = {"crop_width": width, "crop_height": height, "crop_offset_x": 0, "crop_offset_y": 0}
    if any(film.number(key, size) != size for key, size in whole.items()):
        materials.lose("crops of the film: the whole film in their place", film.label)
    return FilmSettings(width, height, max_depth=_depth(root))


def _depth(root: Plugin) -> int:
    """The longest path in segments, of the innermost integrator."""
    integrators, depth = root.inner("integrator"), -1
    while integrators:
        depth = 2 if integrators[0].type == "direct" else int(integrators[0].number("max_depth", -1))
        integrators = integrators[0].inner("integrator")
    return depth if depth > 0 else UNBOUNDED


def read_camera(sensor: Plugin, film: FilmSettings, materials: Materials, world: np.ndarray) -> dict[str, Any]:
    """The camera as a table of a scene file."""
    matrix = world @ sensor.matrix()
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0).clip(1e-12)
    if np.linalg.det(axes) < 0.0:
        materials.lose("mirrored sensors: the picture is not mirrored", sensor.label)
    if any(sensor.number(f"principal_point_offset_{axis}", 0.0) for axis in "xy"):
        materials.lose("principal points outside the middle: the middle in their place", sensor.label)
    position = matrix[:3, 3]
    focus = sensor.number("focus_distance", 1.0) if sensor.type == "thinlens" else 1.0
    values: dict[str, Any] = {
        "position": position.tolist(),
        "target": (position + axes[:, 2] * focus).tolist(),
        "up": axes[:, 1].tolist(),
        "fov": _horizontal_fov(sensor, film),
    }
    if sensor.type == "thinlens":
        values |= {"aperture_radius": sensor.number("aperture_radius", 0.0), "focus_distance": focus}
    return values


def _horizontal_fov(sensor: Plugin, film: FilmSettings) -> float:
    """The horizontal field of view in degrees, from `fov` and `fov_axis` or from `focal_length` on 36 × 24 mm."""
    width, height = float(film.width), float(film.height)
    extents = {"x": width, "y": height, "smaller": min(width, height), "larger": max(width, height)}
    extents["diagonal"] = math.hypot(width, height)
    if "fov" in sensor.values:
        axis, half = sensor.text("fov_axis", "x"), math.tan(math.radians(sensor.number("fov", 40.0)) / 2.0)
    else:
        axis = "diagonal"
        length = sensor.text("focal_length", "50mm").removesuffix("mm")
        try:
            half = math.hypot(36.0, 24.0) / 2.0 / float(length)
        except (ValueError, ZeroDivisionError):
            sensor.fail("focal_length", 'is no length; give millimetres, as in "50mm"')
    if axis not in extents:
        sensor.fail("fov_axis", f"is none of {', '.join(extents)}; give one of them")
    return math.degrees(2.0 * math.atan(half * width / extents[axis]))
