"""The field of view of Blender's cameras: sensor fit, shift, pixel aspect and render border. Needs no Blender."""

from __future__ import annotations

import math
from dataclasses import dataclass

Border = tuple[float, float, float, float]
"""Left, right, bottom and top edge, in fractions of the frame from its bottom left corner."""


@dataclass(frozen=True)
class Framing:
    """A frame of bokehguide and the window of the frame that is the picture.

    fov: horizontal field of view of the frame in degrees. size: width and height of the frame in pixels. window: left, top, width
    and height in pixels from the frame's top left corner. shift_error: distance in pixels between the asked and the given shift.
    """

    fov: float
    size: tuple[int, int]
    window: tuple[int, int, int, int]
    shift_error: float = 0.0

    @property
    def cropped(self) -> bool:
        """Whether the window is a part of the frame."""
        return self.window != (0, 0, *self.size)


def frame(
    lens: float,
    sensor: tuple[float, float],
    fit: str,
    size: tuple[int, int],
    shift: tuple[float, float] = (0.0, 0.0),
    border: Border | None = None,
) -> Framing:
    """The frame of a perspective camera with square pixels.

    lens: focal length in millimetres. sensor: width and height in millimetres. fit: "AUTO", "HORIZONTAL" or "VERTICAL". size: of the
    picture in pixels. shift: of the lens, in fractions of the side that the sensor fits. A shift makes the frame larger than the
    picture, as the optical axis goes through the middle of a frame; its resolution is half a pixel.
    """
    width, height = size
    horizontal = width >= height if fit == "AUTO" else fit == "HORIZONTAL"
    fitted = width if horizontal else height
    slope = (sensor[1] if fit == "VERTICAL" else sensor[0]) / lens / fitted
    left, right, bottom, top = border or (0.0, 1.0, 0.0, 1.0)
    # As Blender rounds a border.
    columns, rows = (int(left * width), int(right * width)), (int(bottom * height), int(top * height))
    whole_width, column, error_x = _around(width, shift[0] * fitted)
    whole_height, row, error_y = _around(height, -shift[1] * fitted)
    window = (column + columns[0], row + height - rows[1], columns[1] - columns[0], rows[1] - rows[0])
    fov = 2.0 * math.degrees(math.atan(0.5 * slope * whole_width))
    return Framing(fov, (whole_width, whole_height), window, math.hypot(error_x, error_y))


def _around(side: int, shift: float) -> tuple[int, int, float]:
    """The side of a frame whose window of `side` pixels lies `shift` pixels from the middle, the window's start, and the error."""
    halves = round(2.0 * shift)
    return side + abs(halves), max(halves, 0), abs(shift - 0.5 * halves)


def aperture_radius(lens: float, f_stop: float) -> float:
    """Radius of the lens in metres from the focal length in millimetres. Blender's smallest f-stop is above 0."""
    return 0.001 * lens / (2.0 * f_stop)
