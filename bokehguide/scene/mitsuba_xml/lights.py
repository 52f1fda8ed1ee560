"""Emitters of Mitsuba as emission, environments, suns and small spheres."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.scene.checks import located
from bokehguide.scene.environments import constant_radiance, load_environment_map
from bokehguide.scene.files import SceneFiles, require_map
from bokehguide.scene.mitsuba_xml.materials import Materials
from bokehguide.scene.mitsuba_xml.sunsky import read_sunsky
from bokehguide.scene.mitsuba_xml.textures import color_of, is_image, kind_of
from bokehguide.scene.mitsuba_xml.tree import Plugin
from bokehguide.scene.model import LightSizes
from bokehguide.scene.shapes import spheres
from bokehguide.scene.types import Cone, Environment, Material, Mesh, Sun, Vector, as_vector

POINT_RADIUS = 0.01
"""Metres; the radius of the spheres that stand for point lights, as for those of glTF."""


def read_emission(emitter: Plugin, materials: Materials) -> dict[str, Any]:
    """The fields of `Material` of an area emitter."""
    radiance = emitter.values.get("radiance")
    if is_image(radiance):
        return {"emission": (1.0, 1.0, 1.0), "emission_texture": materials.textures.read(radiance)}
    return {"emission": _light(emitter, "radiance", materials)}


def _light(emitter: Plugin, key: str, materials: Materials) -> Vector:
    """The colour of the light of an emitter. Raises BokehguideError for a negative channel."""
    value = emitter.values.get(key, 1.0)
    color = color_of(value, emitter.place, light=True)
    if color is None:
        materials.lose(f"{key} of the type {kind_of(value)}: 1.0 in its place", emitter.label)
        return 1.0, 1.0, 1.0
    if min(color) < 0.0:
        emitter.fail(key, "has a negative channel; give numbers of 0 or more")
    return color


def read_lights(
    root: Plugin, path: Path, files: SceneFiles, materials: Materials, meshes: list[Mesh], world: np.ndarray
) -> tuple[Environment | None, list[Sun]]:
    """Environment and suns; appends spheres for point lights to `meshes`. world: see `scene_from_world`."""
    environment, suns = None, []
    for emitter in root.inner("emitter"):
        name = emitter.label
        if emitter.type == "constant":
            environment = Environment(constant_radiance(_light(emitter, "radiance", materials)))
        elif emitter.type == "envmap":
            environment = _map(emitter, path, files, world)
        elif emitter.type == "sunsky":
            with located(emitter.place):
                environment, found = read_sunsky(emitter, materials)
            suns += found
        elif emitter.type == "directional":
            suns.append(_sun(emitter, materials, world))
            materials.lose(f"directional lights: discs of {LightSizes.sun_angle}°", name)
        elif emitter.type in ("point", "spot"):
            meshes.append(_point(emitter, materials, world))
            cone = " with a cone of the same flux" if emitter.type == "spot" else ""
            materials.lose(f"{emitter.type} lights: spheres of radius {POINT_RADIUS} m{cone}", name)
        elif emitter.type != "area":  # which shapes refer to
            materials.lose(f"emitters of the type {emitter.type}: left out", name)
    return environment, suns


def _map(emitter: Plugin, path: Path, files: SceneFiles, world: np.ndarray) -> Environment:
    """An environment map. A mirrored one has its columns in reverse."""
    source = files.find(path.parent, emitter.text("filename"), f"{emitter.place}.filename")
    require_map(source, f"{emitter.place}.filename")
    radiance, _ = load_environment_map(source)
    axes = world[:3, :3] @ emitter.matrix()[:3, :3]
    if np.linalg.det(axes) < 0.0:
        radiance = np.ascontiguousarray(radiance[:, ::-1])
    scale = emitter.number("scale", 1.0)
    if scale < 0.0:
        emitter.fail("scale", "is negative; give a number of 0 or more")
    # Mitsuba's centre of the map lies at +z, that of bokehguide at -z.
    angle = math.degrees(math.atan2(axes[0, 2], axes[2, 2])) - 180.0
    return Environment(radiance * np.float32(scale), angle)


def _sun(emitter: Plugin, materials: Materials, world: np.ndarray) -> Sun:
    """A directional light as a sun."""
    direction = emitter.vector("direction", emitter.matrix()[:3, 2])
    if not direction.any():
        emitter.fail("direction", "is no direction; give x, y and z")
    unit = -direction / np.linalg.norm(direction)
    return Sun(as_vector(world[:3, :3] @ unit), LightSizes.sun_angle, _light(emitter, "irradiance", materials))


def _point(emitter: Plugin, materials: Materials, world: np.ndarray) -> Mesh:
    """A point light or a spotlight as a small sphere of the same intensity, before the turn of the world."""
    position = emitter.vector("position", emitter.matrix()[:3, 3])
    emission = as_vector(channel / (math.pi * POINT_RADIUS**2) for channel in _light(emitter, "intensity", materials))
    name, cone = emitter.name or f"{emitter.type} light", _cone(emitter, materials, world) if emitter.type == "spot" else None
    materials.all.append(Material(name, (0.0, 0.0, 0.0), specular=0.0, emission=emission, emission_cone=cone))
    sphere = spheres(position[None], np.array([POINT_RADIUS]), len(materials.all) - 1)
    return replace(sphere, name=name)


def _cone(emitter: Plugin, materials: Materials, world: np.ndarray) -> Cone:
    """The cone of a spotlight about its z axis.

    Mitsuba's falloff from `beam_width` to `cutoff_angle` is linear in the angle. The inner angle of the cone gives the same flux:
    with cosines h and l of its angles, the integral of the falloff over the cosine is 1 - 2h/3 - l/3.
    """
    if "texture" in emitter.values:
        materials.lose("textures of spotlights: left out", emitter.label)
    outer = min(max(emitter.number("cutoff_angle", 20.0), 0.1), 90.0)
    width = min(max(emitter.number("beam_width", 0.75 * outer), 0.0), outer - 0.05)
    cutoff, beam = math.radians(outer), math.radians(width)
    high = 1.5 * (math.sin(cutoff) - math.sin(beam)) / (cutoff - beam) - 0.5 * math.cos(cutoff)
    inner = min(math.degrees(math.acos(min(high, 1.0))), outer - 0.01)
    axis = world[:3, :3] @ emitter.matrix()[:3, 2]
    if not np.linalg.norm(axis) > 0.0:
        emitter.fail("to_world", "has no direction; give another transform")
    return Cone(as_vector(axis / np.linalg.norm(axis)), inner, outer)
