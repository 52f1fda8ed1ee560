"""The frame of a Mitsuba sensor as the lens guide sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.types import Camera

OFFSETS = ("principal_point_offset_x", "principal_point_offset_y")


@dataclass(frozen=True)
class Frame:
    """The film with a border on each side, for filters that reach beyond it.

    camera: in the coordinates of the sensor, at the origin, looking along +z. to_world: of the sensor, float64 `[4, 4]`. border:
    pixels on each side. width, height: with the borders. pixels: that the film renders, int64 `[N]`. corner, size: of the film's
    crop.
    """

    camera: Camera
    to_world: np.ndarray
    border: int
    width: int
    height: int
    pixels: np.ndarray
    corner: tuple[int, int]
    size: tuple[int, int]


def read_frame(sensor: Any) -> Frame:
    """The frame of a thin lens. Raises BokehguideError for another sensor, and for a shifted one."""
    if sensor.class_name() != "ThinLensCamera":
        raise BokehguideError(f"guided_thinlens: the sensor is a {sensor.class_name()}; give a sensor of the type thinlens")
    film, values = sensor.film(), mi.traverse(sensor)
    for name in OFFSETS:
        if name in values and first_number(values[name]) != 0.0:
            raise BokehguideError(f"guided_thinlens: {name} of the sensor is not supported; leave it out")
    border = film.rfilter().border_size() if film.sample_border() else 0
    (width, height), corner, size = ((int(x), int(y)) for x, y in (film.size(), film.crop_offset(), film.crop_size()))
    slope = math.tan(math.radians(first_number(values["x_fov"])) / 2.0) * (width + 2 * border) / width
    camera = Camera(
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 1.0),
        fov=math.degrees(2.0 * math.atan(slope)),
        aperture_radius=first_number(values["aperture_radius"]),
        focus_distance=first_number(values["focus_distance"]),
    )
    (left, top), (across, down) = corner, size
    rows, columns = np.mgrid[top : top + down + 2 * border, left : left + across + 2 * border]
    pixels = (rows * (width + 2 * border) + columns).ravel()
    return Frame(camera, matrix(values["to_world"]), border, width + 2 * border, height + 2 * border, pixels, corner, size)


def first_number(value: Any) -> float:
    """A number of Mitsuba, whatever its type."""
    return float(np.array(value).ravel()[0])


def matrix(transform: Any) -> np.ndarray:
    """A transform of Mitsuba as float64 `[4, 4]`."""
    return np.array(transform.matrix, np.float64).reshape(4, 4)
