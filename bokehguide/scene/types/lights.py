"""Light from afar, and the falloff of spotlights. Other lights are meshes with an emissive material."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bokehguide.scene.checks import Fields, check_light_group
from bokehguide.scene.tables import ANY, CONE_ANGLE, NOT_NEGATIVE, SUN_ANGLE
from bokehguide.scene.types.fields import LABEL
from bokehguide.scene.vectors import Vector


@dataclass(frozen=True)
class Cone:
    """Angular falloff of a spotlight: full radiance within `inner` degrees of `axis`, none beyond `outer`.

    With t from 0 at `outer` to 1 at `inner`, linear in the cosine, the falloff in between is t² as in KHR_lights_punctual, or
    3t² - 2t³ for `smooth` cones, as in Blender. axis: unit, in world space.
    """

    axis: Vector
    inner: float
    outer: float
    smooth: bool = False

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_direction("axis")
        fields.check_numbers(inner=CONE_ANGLE, outer=CONE_ANGLE)
        fields.check_flags("smooth")
        if self.inner >= self.outer:
            fields.fail("outer", f"is not above inner, {self.inner:g}; give a larger angle")


@dataclass(frozen=True)
class Sun:
    """A disc of constant radiance at infinity.

    direction: unit, from the scene towards the sun. angle: diameter of the disc in degrees.
    irradiance: on a surface perpendicular to `direction`, linear Rec.709. light_group: as that of a `Material`.
    """

    direction: Vector
    angle: float
    irradiance: Vector
    light_group: str = field(default="", metadata={LABEL: True})

    def __post_init__(self) -> None:
        fields = Fields(self)
        check_light_group(fields)
        fields.check_direction("direction")
        fields.check_numbers(angle=SUN_ANGLE)
        fields.check_vectors(irradiance=NOT_NEGATIVE)


@dataclass(frozen=True, eq=False)
class Environment:
    """An environment map: equirectangular radiance, float32 `[H, W, 3]`, top row towards +y.

    The map's centre lies at -z and u grows towards +x. A constant colour is a 1 × 1 map, or three numbers.
    rotation: degrees about +y, anticlockwise seen from above. visible: if False, camera rays that
    escape see neither map nor suns and have alpha 0; the lighting stays. light_group: as that of a `Material`.
    """

    radiance: np.ndarray
    rotation: float = 0.0
    visible: bool = True
    light_group: str = field(default="", metadata={LABEL: True})

    def __post_init__(self) -> None:
        fields = Fields(self)
        check_light_group(fields)
        if np.shape(fields.values["radiance"]) == (3,):
            fields.values["radiance"] = np.asarray(fields.values["radiance"])[None, None]
        fields.check_array("radiance", ("H", "W", 3), low=0.0)
        fields.check_numbers(rotation=ANY)
        fields.check_flags("visible")
