"""UsdLux lights: spheres, discs, rectangles and cylinders that emit, and suns.

The radiance of a light is intensity · 2^exposure · colour. A light with `normalize` divides the radiance by its area in scene
units, as the schema's units have it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bokehguide.limits import LARGEST
from bokehguide.scene.checks import located
from bokehguide.scene.shapes import surface_area, transform, transformed, tube, unit_disc, unit_rectangle, unit_sphere
from bokehguide.scene.tables import CONE_ANGLE, SUN_ANGLE
from bokehguide.scene.types import Cone, Material, Mesh, Sun, Texture, Vector, as_vector
from bokehguide.scene.usd.images import light_image
from bokehguide.scene.usd.libraries import UsdLux
from bokehguide.scene.usd.prims import Placed
from bokehguide.scene.usd.shapes import along, number
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.textures import Textures

POINT_RADIUS = 0.01
"""Metres; the radius of spheres without one, as for the point lights of glTF."""
AREA_LIGHTS = ("SphereLight", "DiskLight", "RectLight", "CylinderLight")
NARROWEST = 0.01
"""Degrees between the full radiance and none at the edge of a hard cone."""


def read_area_light(opened: Stage, placed: Placed, textures: Textures) -> tuple[Material, Mesh] | None:
    """The material of a light with a size, and its mesh in its own space; None, with a note, for one that is dark.

    Raises BokehguideError, naming the prim, for sizes out of range.
    """
    prim, name = placed.prim, placed.name
    shape = _shape(opened, prim)
    with located(opened.place(prim)):
        area = surface_area(transformed(shape, placed.matrices[0])) / opened.unit**2
        radiance = radiance_of(opened, prim, area)
        if not area > 0.0 or not any(radiance):
            opened.lose("lights without a size or without an intensity: left out", name)
            return None
        _note_lost(opened, prim, name)
        texture = None
        image = light_image(opened, prim, textures) if prim.GetTypeName() == "RectLight" else None
        if image is not None:
            peak = max(float(image.max()), 1e-30)
            texture, radiance = Texture(image / np.float32(peak)), as_vector(peak * channel for channel in radiance)
        cone = _cone(opened, prim, placed.matrices[0], name)
        material = Material(name, (0.0, 0.0, 0.0), specular=0.0, emission=radiance, emission_cone=cone, emission_texture=texture)
    return material, shape


def read_sun(opened: Stage, placed: Placed) -> list[Sun]:
    """A distant light as suns, one for each instance."""
    prim = placed.prim
    angle = number(opened, prim, "inputs:angle")
    size = math.pi * math.sin(math.radians(min(angle, 180.0)) / 2.0) ** 2
    irradiance = radiance_of(opened, prim, size) if size > 0.0 else radiance_of(opened, prim, 1.0)
    irradiance = as_vector(min(channel * (size if size > 0.0 else 1.0), LARGEST) for channel in irradiance)
    if angle > SUN_ANGLE.high:
        opened.lose(f"distant lights wider than {SUN_ANGLE.high:g} degrees: drawn with this angle", placed.name)
    _note_lost(opened, prim, placed.name)
    axes = placed.matrices[:, :3, 2]
    angle = min(max(angle, SUN_ANGLE.low), SUN_ANGLE.high)
    with located(opened.place(prim)):
        return [Sun(as_vector(axis / np.linalg.norm(axis)), angle, irradiance) for axis in axes if np.linalg.norm(axis) > 0.0]


def radiance_of(opened: Stage, prim: Any, area: float) -> Vector:
    """The radiance of a light, divided by `area` if it is normalized."""
    light, time = UsdLux.LightAPI(prim), opened.time
    with np.errstate(over="ignore", invalid="ignore"):
        scale = np.float64(light.GetIntensityAttr().Get(time)) * np.exp2(np.float64(light.GetExposureAttr().Get(time)))
        color = scale * np.asarray(light.GetColorAttr().Get(time), np.float64)
        if light.GetEnableColorTemperatureAttr().Get(time):
            kelvin = light.GetColorTemperatureAttr().Get(time)
            color = color * np.asarray(UsdLux.BlackbodyTemperatureAsRgb(kelvin), np.float64)
        if light.GetNormalizeAttr().Get(time) and area > 0.0:
            color = color / area
    return as_vector(np.nan_to_num(color, posinf=0.0).clip(0.0, LARGEST))


def _shape(opened: Stage, prim: Any) -> Mesh:
    """The surface of a light in its own space; its front emits."""
    kind, size = prim.GetTypeName(), lambda name: number(opened, prim, f"inputs:{name}")
    turned = transform(rotate=(0.0, 180.0, 0.0))
    if kind == "RectLight":
        return transformed(transformed(unit_rectangle(), transform(scale=(size("width") / 2, size("height") / 2, 1.0))), turned)
    if kind == "DiskLight":
        radius = size("radius")
        return transformed(transformed(unit_disc(), transform(scale=(radius, radius, 1.0))), turned)
    if kind == "CylinderLight":
        return along(tube(size("radius"), size("length"), size("radius")), "X")
    return transformed(unit_sphere(), transform(scale=size("radius") or POINT_RADIUS / opened.unit))


def _cone(opened: Stage, prim: Any, matrix: np.ndarray, name: str) -> Cone | None:
    """The cone of a light with the shaping schema; None without a restriction."""
    if not prim.HasAPI(UsdLux.ShapingAPI):
        return None
    shaping = UsdLux.ShapingAPI(prim)
    if (shaping.GetShapingFocusAttr().Get(opened.time) or 0.0) != 0.0:
        opened.lose("the focus of lights: left out", name)
    if getattr(shaping.GetShapingIesFileAttr().Get(opened.time), "path", ""):
        opened.lose("IES profiles: left out", name)
    outer, axis = number(opened, prim, "inputs:shaping:cone:angle"), -matrix[:3, 2]
    if outer >= CONE_ANGLE.high or not np.linalg.norm(axis) > 0.0:
        if outer < 180.0 and prim.GetTypeName() in ("SphereLight", "CylinderLight") and outer > CONE_ANGLE.high:
            opened.lose(f"cones of lights wider than {CONE_ANGLE.high:g} degrees from their axis: left out", name)
        return None
    outer = max(outer, NARROWEST)
    softness = min(max(float(shaping.GetShapingConeSoftnessAttr().Get(opened.time) or 0.0), 0.0), 1.0)
    inner = min((1.0 - softness) * outer, outer - NARROWEST)
    return Cone(as_vector(axis / np.linalg.norm(axis)), max(inner, 0.0), outer, smooth=True)


def _note_lost(opened: Stage, prim: Any, name: str) -> None:
    """Note the values of a light that a path tracer has no use for."""
    for key in ("diffuse", "specular"):
        if (value := prim.GetAttribute(f"inputs:{key}").Get(opened.time)) is not None and value != 1.0:
            opened.lose(f"the factor {key} of lights: left out", name)
