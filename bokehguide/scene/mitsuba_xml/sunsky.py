"""The emitter `sunsky` as an environment map and a sun, by Mitsuba itself."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from bokehguide.scene.mitsuba_xml.materials import Materials
from bokehguide.scene.mitsuba_xml.tree import Plugin, mitsuba
from bokehguide.scene.types import Environment, Sun, as_vector

HEIGHT = 128
"""Rows of the map."""
SIDE = 16
"""Square root of the number of directions whose mean is the centre of the sun."""
APERTURE = 0.5338
"""Mitsuba's diameter of the sun in degrees, unless the file gives another."""
WHEN_AND_WHERE = ("latitude", "longitude", "timezone", "year", "month", "day", "hour", "minute", "second")
KEYS = {"turbidity", "albedo", "sun_direction", "sky_scale", "sun_scale", "sun_aperture", "to_world", *WHEN_AND_WHERE}


def read_sunsky(emitter: Plugin, materials: Materials) -> tuple[Environment, list[Sun]]:
    """The sky as a map `[HEIGHT, 2 HEIGHT, 3]`, and the sun unless it is dark or below the horizon.

    Raises BokehguideError for values that Mitsuba refuses.
    """
    values: dict[str, Any] = {}
    for key, value in emitter.values.items():
        if key not in KEYS or isinstance(value, Plugin):
            materials.lose(f"{key} of sunsky: left out", emitter.label)
        else:
            values[key] = value
    with mitsuba(emitter.place) as mi:
        if "to_world" in values:
            values["to_world"] = mi.ScalarTransform4f(emitter.matrix())
        if isinstance(values.get("albedo"), tuple):
            values["albedo"] = {"type": "rgb", "value": list(values["albedo"])}
        sky, sun = (_load(mi, emitter, values | {dark: 0.0}) for dark in ("sun_scale", "sky_scale"))
        return Environment(_map(mi, sky)), _suns(mi, sun, emitter.number("sun_aperture", APERTURE))


def _load(mi: ModuleType, emitter: Plugin, values: dict[str, Any]) -> Any:
    """Mitsuba's emitter."""
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}
    try:
        return mi.load_dict({"type": "sunsky"} | plain)
    except (RuntimeError, TypeError, ValueError):
        emitter.fail("turbidity", "or another value is none that Mitsuba's sunsky takes; give values in its ranges")


def _map(mi: ModuleType, sky: Any) -> np.ndarray:
    """Radiance in the directions of the texels; negative channels are 0."""
    polar = (np.arange(HEIGHT) + 0.5) * np.pi / HEIGHT
    azimuth = (np.arange(2 * HEIGHT) + 0.5) * np.pi / HEIGHT - np.pi
    radiance, at = np.zeros((HEIGHT, 2 * HEIGHT, 3), np.float32), mi.SurfaceInteraction3f()
    for row, angle in enumerate(polar):
        for column, turn in enumerate(azimuth):
            at.wi = mi.Vector3f(-np.sin(turn) * np.sin(angle), -np.cos(angle), np.cos(turn) * np.sin(angle))
            radiance[row, column] = np.ravel(np.array(sky.eval(at)))
    return np.nan_to_num(radiance, nan=0.0, posinf=0.0, neginf=0.0).clip(min=0.0)


def _suns(mi: ModuleType, sun: Any, angle: float) -> list[Sun]:
    """The sun, from samples of its disc: their mean direction, and their mean weight as the irradiance."""
    at, direction, irradiance = mi.SurfaceInteraction3f(), np.zeros(3), np.zeros(3)
    for row, column in np.ndindex(SIDE, SIDE):
        found, weight = sun.sample_direction(at, mi.Point2f((row + 0.5) / SIDE, (column + 0.5) / SIDE))
        direction += np.ravel(np.array(found.d))
        irradiance += np.ravel(np.array(weight)) / SIDE**2
    irradiance = np.nan_to_num(irradiance, nan=0.0).clip(min=0.0)
    length = np.linalg.norm(direction)
    return [Sun(as_vector(direction / length), angle, as_vector(irradiance))] if irradiance.any() and length > 0.0 else []
