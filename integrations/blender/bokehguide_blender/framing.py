"""The field of view of Blender's cameras: sensor fit, shift, pixel aspect and render border. Needs no Blender."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .axes import Matrix

Border = tuple[float, float, float, float]
"""Left, right, bottom and top edge, in fractions of the frame from its bottom left corner."""

FARNESS = 100.0
"""Distance of the camera of a view without perspective, in halves of the view's width."""


@dataclass(frozen=True)
class Framing:
    """A frame of bokehguide and the window of the frame that is the picture.

    fov: horizontal field of view of the frame in degrees. size: width and height of the frame in pixels. window: left, top, width
    and height in pixels from the frame's top left corner.
    """

    fov: float
    size: tuple[int, int]
    window: tuple[int, int, int, int]

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

    lens: focal length in millimetres. sensor: width and height in millimetres. fit: "AUTO", "HORIZONTAL" or "VERTICAL".
    size: of the picture in pixels. shift: of the lens, in fractions of the side that the sensor fits. border: the rendered part.
    A shift makes the frame larger than the picture, as the optical axis goes through the middle of a frame. A shift is rounded
    to half a pixel.
    """
    width, height = size
    horizontal = width >= height if fit == "AUTO" else fit == "HORIZONTAL"
    fitted = width if horizontal else height
    slope = (sensor[1] if fit == "VERTICAL" else sensor[0]) / lens / fitted
    left, right, bottom, top = border or (0.0, 1.0, 0.0, 1.0)
    # As Blender rounds a border.
    columns, rows = (int(left * width), int(right * width)), (int(bottom * height), int(top * height))
    whole_width, column = _around(width, shift[0] * fitted)
    whole_height, row = _around(height, -shift[1] * fitted)
    window = (column + columns[0], row + height - rows[1], columns[1] - columns[0], rows[1] - rows[0])
    fov = 2.0 * math.degrees(math.atan(0.5 * slope * whole_width))
    return Framing(fov, (whole_width, whole_height), window)


def projected(matrix: Matrix, size: tuple[int, int], depth: float) -> tuple[Framing, float]:
    """The frame of a 3D viewport of `size` pixels, and how many metres its camera stands behind the viewport's.

    matrix: rows of the projection. A projection without perspective becomes that of a camera far away, so that the plane at
    `depth` metres has its size: the distance of this plane is FARNESS times half of the viewport's width.
    """
    width, height = size
    perspective = matrix[3][3] == 0.0
    across, up = (-matrix[0][2], -matrix[1][2]) if perspective else (matrix[0][3], matrix[1][3])  # the axis, from -1 to 1
    whole_width, column = _around(width, -0.5 * across * width)
    whole_height, row = _around(height, 0.5 * up * height)
    half = whole_width / width * (1.0 / matrix[0][0] if perspective else 1.0 / FARNESS)
    back = 0.0 if perspective else FARNESS / matrix[0][0] - depth
    fov = 2.0 * math.degrees(math.atan(half))
    return Framing(fov, (whole_width, whole_height), (column, row, width, height)), back


def _around(side: int, shift: float) -> tuple[int, int]:
    """The side of a frame, and the start of the window of `side` pixels whose middle lies `shift` pixels from the frame's."""
    halves = round(2.0 * shift)
    return side + abs(halves), max(halves, 0)


def aperture_radius(lens: float, f_stop: float) -> float:
    """Radius of the lens in metres from the focal length in millimetres."""
    return 0.001 * lens / (2.0 * f_stop)
