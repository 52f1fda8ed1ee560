"""The camera, and the shape of its lens opening."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bokehguide.scene.checks import Fields, iris_blades, viewing_direction
from bokehguide.scene.tables import (
    ANGLE_OF_VIEW,
    ANY,
    CAT_EYE,
    FRACTION,
    IN_FRONT,
    NOT_NEGATIVE,
    POSITIVE,
    RATIO,
    SIGNED_FRACTION,
)
from bokehguide.scene.vectors import Vector

SENSOR_WIDTH = 36.0
"""Millimetres; the default sensor for focal lengths and f-numbers."""


@dataclass(frozen=True, eq=False)
class Aperture:
    """The shape of a lens opening, seen from behind the camera.

    The bokeh of anything beyond the focal plane has the same orientation. The lens radius r is the
    circumradius of a polygon, half the height of an opening with a ratio, or half the longer side of a mask.

    blades: number of iris blades, 0 for a disc. The middle of one polygon edge lies to the right.
    rotation: degrees, anticlockwise. curvature: of the polygon edges, 0 straight, 1 a circle.
    ratio: divides the width, as in Blender. image: a mask in place of the blades, its transmission
    as linear float32 `[H, W]`, top row first. cat_eye: offset of the second opening that vignettes
    the frame's corners, in r. edge: from -1 to 1; the transmission is 1 + edge (2t² - 1) at the
    relative distance t from the centre.
    """

    blades: int = 0
    rotation: float = 0.0
    curvature: float = 0.0
    ratio: float = 1.0
    image: np.ndarray | None = None
    cat_eye: float = 0.0
    edge: float = 0.0

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.keep("blades", iris_blades(fields))
        fields.check_numbers(rotation=ANY, curvature=FRACTION, ratio=RATIO, cat_eye=CAT_EYE, edge=SIGNED_FRACTION)
        if self.image is not None and not fields.check_array("image", ("H", "W"), low=0.0).any():
            fields.fail("image", "is black all over and lets no light through; give an image with brighter pixels")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Aperture) and self._values == other._values

    def __hash__(self) -> int:
        return hash(self._values)

    @property
    def _values(self) -> tuple[object, ...]:
        """The fields, with an image as its shape and its bytes, which are hashable."""
        image = None if self.image is None else (self.image.shape, self.image.tobytes())
        return self.blades, self.rotation, self.curvature, self.ratio, image, self.cat_eye, self.edge


@dataclass(frozen=True)
class Camera:
    """A thin-lens camera at `position` that looks at `target`.

    fov: horizontal field of view in degrees. aperture_radius: lens radius in metres, 0 for a pinhole.
    focus_distance: metres from the lens to the focal plane along the optical axis; FARTHEST_FOCUS
    or more is infinity. aperture: shape of the lens opening; None is a disc. sensor_width: of the
    f-number, millimetres.
    """

    position: Vector
    target: Vector
    up: Vector = (0.0, 1.0, 0.0)
    fov: float = 40.0
    aperture_radius: float = 0.0
    focus_distance: float = 1.0
    aperture: Aperture | None = None
    sensor_width: float = SENSOR_WIDTH

    @property
    def f_number(self) -> float:
        """Focal length / lens diameter; inf for a pinhole."""
        if self.aperture_radius == 0.0:
            return math.inf
        return 1e-3 * 0.5 * self.sensor_width / math.tan(math.radians(self.fov) / 2.0) / (2.0 * self.aperture_radius)

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_vectors(position=ANY, target=ANY, up=ANY)
        fields.check_numbers(fov=ANGLE_OF_VIEW, aperture_radius=NOT_NEGATIVE, focus_distance=IN_FRONT, sensor_width=POSITIVE)
        fields.check_instances(Aperture, "aperture")
        viewing_direction(fields, self.position, self.target, self.up)
