"""KHR_lights_punctual: point and spot lights as small spheres, directional lights as suns.

A light without a size would be invisible to the camera and have no bokeh. Photometric units are
divided by 683 lm/W, as in Blender's importer and exporter, because emissive surfaces have
radiometric units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bokehguide.color import LUMENS_PER_WATT
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.nodes import Placed
from bokehguide.scene.gltf.parts import Part
from bokehguide.scene.model import LightSizes
from bokehguide.scene.shapes import sphere_subdivisions, spheres
from bokehguide.scene.tables import EMITTER_RADIUS, NOT_NEGATIVE, Limits
from bokehguide.scene.types import Cone, Material, Mesh, Sun, Vector, as_vector
from bokehguide.scene.validation import check_triangles

EXTENSION = "KHR_lights_punctual"
MAX_RADIUS, RELATIVE_RADIUS = 0.01, 0.01
"""Default radius of a light: at most in metres, and relative to the model's longest side."""
RIGHT_ANGLE = Limits("radians between 0 and half of pi", low=0.0, high=math.pi / 2.0 + 1e-6)


def default_radius(meshes: Sequence[Mesh]) -> float:
    """The radius of a light without a size, in metres."""
    low = np.min([mesh.vertices.min(axis=0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(axis=0) for mesh in meshes], axis=0)
    return max(EMITTER_RADIUS.low, min(MAX_RADIUS, RELATIVE_RADIUS * float((high - low).max())))


def read_lights(
    document: Document, placed: Sequence[Placed], sizes: LightSizes, radius: float
) -> tuple[list[Mesh], list[Material], list[Sun]]:
    """Spheres of `radius` metres, one material for each, and suns.

    The spheres' material indices start at 0. A light of intensity I becomes a sphere of radiance
    I / (π r²), which has the same intensity. Raises BokehguideError naming the light for values out
    of range.
    """
    lights = document.root.extension(EXTENSION).parts("lights")
    meshes, materials, suns = [], [], []
    subdivisions = sphere_subdivisions(sum(EXTENSION in node.node.extensions for node in placed))
    for node in placed:
        if EXTENSION not in node.node.extensions:
            continue
        link = node.node.extension(EXTENSION)
        index = link.whole("light", 0)
        if index >= len(lights):
            link.fail("light", f"is no index into the file's {len(lights)} lights; repair the file")
        light, position = lights[index], node.matrix[:3, 3]
        kind, axis = light.values.get("type"), _axis(node.matrix)
        if kind not in ("point", "spot", "directional") or axis is None:
            document.note("lights of an unknown type or without a direction: left out", light.label)
        elif kind == "directional":
            irradiance = _power(light, 1.0)
            suns += [Sun(as_vector(-axis), sizes.sun_angle, irradiance)] if any(irradiance) else []
        elif any(radiance := _power(light, math.pi * radius**2)):
            cone = _cone(light, axis) if kind == "spot" else None
            sphere = spheres(position[None], radius, len(materials), subdivisions)
            meshes.append(replace(sphere, name=node.node.label, groups=(light.label, *node.groups)))
            count = len(meshes) * len(meshes[0].triangles)
            check_triangles(count, f"{document.file}: {node.node.path}", document.files.most_triangles)
            black = Material(light.label, base_color=(0.0, 0.0, 0.0), specular=0.0)
            materials.append(replace(black, emission=radiance, emission_cone=cone))
        if "range" in light:
            document.note("the range of lights: has no effect", light.label)
    return meshes, materials, suns


def _axis(matrix: np.ndarray) -> np.ndarray | None:
    """The unit vector along a node's -z axis, None if the axis is 0 or not finite."""
    length = np.linalg.norm(matrix[:3, 2])
    return -matrix[:3, 2] / length if 0.0 < length < np.inf else None


def _power(light: Part, area: float) -> Vector:
    """Colour times intensity in radiometric units, divided by `area`."""
    intensity = light.number("intensity", 1.0, NOT_NEGATIVE) / (LUMENS_PER_WATT * area)
    power = as_vector(intensity * channel for channel in light.vector("color", (1.0, 1.0, 1.0), NOT_NEGATIVE))
    if not all(map(NOT_NEGATIVE.contains, power)):
        light.fail("intensity", f"makes a radiance of {max(power):g}; give less; the maximum is {NOT_NEGATIVE.high:g}")
    return power


def _cone(light: Part, axis: np.ndarray) -> Cone:
    """The cone of a spotlight. axis: unit, in world space."""
    spot = light.part("spot")
    inner = spot.number("innerConeAngle", 0.0, RIGHT_ANGLE)
    outer = spot.number("outerConeAngle", math.pi / 4.0, RIGHT_ANGLE)
    if inner >= outer:
        spot.fail("outerConeAngle", f"is not above innerConeAngle, {inner:g}; repair the file")
    return Cone(as_vector(axis), math.degrees(inner), min(math.degrees(outer), 90.0))
