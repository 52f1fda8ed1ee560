"""Mitsuba XML files as scenes: shapes, BSDFs, emitters and the sensor, as far as they have counterparts."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.checks import located
from bokehguide.scene.environments import constant_radiance, load_environment_map
from bokehguide.scene.files import SceneFiles, require_map
from bokehguide.scene.losses import UNKNOWN_NAMES, loss_lines, unknown_name
from bokehguide.scene.mitsuba_xml.materials import Materials, color_of, is_bitmap, kind_of
from bokehguide.scene.mitsuba_xml.properties import unknown_properties
from bokehguide.scene.mitsuba_xml.shapes import read_shape
from bokehguide.scene.mitsuba_xml.sunsky import read_sunsky
from bokehguide.scene.mitsuba_xml.tree import Plugin, read_tree
from bokehguide.scene.overrides import ChosenCamera, Overrides, override_camera
from bokehguide.scene.shapes import reversed_mesh, spheres
from bokehguide.scene.types import Environment, FilmSettings, LightSizes, Material, Mesh, Scene, Sun, Vector, as_vector
from bokehguide.scene.validation import check_meshes, check_triangles

POINT_RADIUS = 0.01
"""Metres; the radius of the spheres that stand for point lights, as for those of glTF."""
SENSORS = ("thinlens", "perspective")


def read_mitsuba(path: Path, overrides: Overrides, files: SceneFiles) -> tuple[Scene, ChosenCamera]:
    """The scene of an XML file, and its camera with `overrides`. The scene's warnings tell what is lost.

    files: the files that the scene may name. Raises BokehguideError for a missing Mitsuba, an unreadable file, values out of
    range, and a scene without a sensor or without shapes.
    """
    root = read_tree(path, files)
    sensors = [sensor for sensor in root.inner("sensor") if sensor.type in SENSORS]
    if not sensors:
        raise BokehguideError(f"{path}: has no sensor of the type {' or '.join(SENSORS)}; add one")
    materials = Materials(path, files)
    meshes = _meshes(root, path, files, materials)
    environment, suns = _lights(root, path, files, materials, meshes)
    if not meshes:
        raise BokehguideError(f"{path}: holds no shapes that can be drawn; give a scene with some")
    for plugin, key, near in unknown_properties(root):
        materials.lose(UNKNOWN_NAMES, unknown_name(plugin.place.removeprefix(f"{path}: "), key, near))
    film = _film(sensors[0], root, materials)
    chosen = override_camera(_camera(sensors[0], film, materials), overrides, str(path), files, written=True)
    scene = Scene(
        name=path.stem,
        camera=chosen.camera,
        meshes=tuple(meshes),
        materials=tuple(materials.all),
        film=film,
        environment=environment,
        suns=tuple(suns),
        warnings=tuple(loss_lines(materials.lost, path.name)),
    )
    return scene, chosen


def _meshes(root: Plugin, path: Path, files: SceneFiles, materials: Materials) -> list[Mesh]:
    """All shapes with their materials."""
    meshes: list[Mesh] = []
    triangles = 0
    for shape in root.inner("shape"):
        name = shape.name or shape.type
        with located(shape.place):
            found = read_shape(shape, path, files)
        if found is None:
            materials.lose(f"shapes of the type {shape.type}: left out", name)
            continue
        bsdfs, emitters = shape.inner("bsdf"), [each for each in shape.inner("emitter") if each.type == "area"]
        emission = _emission(emitters[0], materials) if emitters else {}
        bsdf = bsdfs[0] if bsdfs else None
        if materials.turned(bsdf):
            if emission:
                materials.lose("glass in a denser medium that emits: the glass is the denser one", name)
            else:
                found = [reversed_mesh(mesh) for mesh in found]
        index = materials.index(bsdf, emission)
        check_meshes(len(meshes) + len(found), shape.place, files.most_meshes)
        triangles += sum(len(mesh.triangles) for mesh in found)
        check_triangles(triangles, shape.place, files.most_triangles)
        meshes += [replace(mesh, material=index, name=printable(name)) for mesh in found]
    return meshes


def _emission(emitter: Plugin, materials: Materials) -> dict[str, Any]:
    """The fields of `Material` of an area emitter."""
    radiance = emitter.values.get("radiance")
    if is_bitmap(radiance):
        return {"emission": (1.0, 1.0, 1.0), "emission_texture": materials.texture(radiance)}
    return {"emission": _light(emitter, "radiance", materials)}


def _light(emitter: Plugin, key: str, materials: Materials) -> Vector:
    """The colour of the light of an emitter. Raises BokehguideError for a negative channel."""
    value = emitter.values.get(key, 1.0)
    color = color_of(value, emitter.place, light=True)
    if color is None:
        materials.lose(f"{key} of the type {kind_of(value)}: 1.0 in its place", emitter.name or emitter.type)
        return 1.0, 1.0, 1.0
    if min(color) < 0.0:
        emitter.fail(key, "has a negative channel; give numbers of 0 or more")
    return color


def _lights(
    root: Plugin, path: Path, files: SceneFiles, materials: Materials, meshes: list[Mesh]
) -> tuple[Environment | None, list[Sun]]:
    """Environment and suns; appends spheres for point lights to `meshes`."""
    environment, suns = None, []
    for emitter in root.inner("emitter"):
        name = emitter.name or emitter.type
        if emitter.type == "constant":
            environment = Environment(constant_radiance(_light(emitter, "radiance", materials)))
        elif emitter.type == "envmap":
            environment = _map(emitter, path, files, materials)
        elif emitter.type == "sunsky":
            with located(emitter.place):
                environment, found = read_sunsky(emitter, materials)
            suns += found
        elif emitter.type == "directional":
            suns.append(_sun(emitter, materials))
            materials.lose(f"directional lights: discs of {LightSizes.sun_angle}°", name)
        elif emitter.type == "point":
            meshes.append(_point(emitter, materials))
            materials.lose(f"point lights: spheres of radius {POINT_RADIUS} m", name)
        else:
            materials.lose(f"emitters of the type {emitter.type}: left out", name)
    return environment, suns


def _map(emitter: Plugin, path: Path, files: SceneFiles, materials: Materials) -> Environment:
    """An environment map. Only its rotation about the vertical counts."""
    source = files.find(path.parent, emitter.text("filename"), f"{emitter.place}.filename")
    require_map(source, f"{emitter.place}.filename")
    radiance, _ = load_environment_map(source)
    axes = emitter.matrix()[:3, :3]
    upright = np.linalg.norm(axes[:, 1] / max(np.linalg.norm(axes[:, 1]), 1e-12) - (0.0, 1.0, 0.0)) < 1e-3
    if not upright:
        materials.lose("environment maps that do not stand upright: only their turn about y counts", emitter.name or "envmap")
    scale = emitter.number("scale", 1.0)
    if scale < 0.0:
        emitter.fail("scale", "is negative; give a number of 0 or more")
    # Mitsuba's centre of the map lies at +z, that of bokehguide at -z.
    angle = math.degrees(math.atan2(axes[0, 2], axes[2, 2])) - 180.0
    return Environment(radiance * np.float32(scale), angle)


def _sun(emitter: Plugin, materials: Materials) -> Sun:
    """A directional light as a sun."""
    away = emitter.matrix()[:3, 2]
    direction = emitter.values.get("direction", tuple(away))
    if not isinstance(direction, tuple) or len(direction) != 3 or not any(direction):
        emitter.fail("direction", "is no direction; give x, y and z")
    unit = -np.array(direction) / np.linalg.norm(direction)
    return Sun(as_vector(unit), LightSizes.sun_angle, _light(emitter, "irradiance", materials))


def _point(emitter: Plugin, materials: Materials) -> Mesh:
    """A point light as a small sphere of the same intensity."""
    position = emitter.values.get("position", tuple(emitter.matrix()[:3, 3]))
    if not isinstance(position, tuple) or len(position) != 3:
        emitter.fail("position", "is no point; give x, y and z")
    emission = as_vector(channel / (math.pi * POINT_RADIUS**2) for channel in _light(emitter, "intensity", materials))
    name = emitter.name or "point light"
    materials.all.append(Material(name, (0.0, 0.0, 0.0), specular=0.0, emission=emission))
    sphere = spheres(np.array([position]), np.array([POINT_RADIUS]), len(materials.all) - 1)
    return replace(sphere, name=name)


def _film(sensor: Plugin, root: Plugin, materials: Materials) -> FilmSettings:
    """Size of the film, and the depth of the integrator."""
    films, integrators = sensor.inner("film"), root.inner("integrator")
    film = films[0] if films else sensor
    depth = int(integrators[0].number("max_depth", -1)) if integrators else -1
    width, height = (int(film.number(key, size)) if films else size for key, size in (("width", 768), ("height", 576)))
    whole = {"crop_width": width, "crop_height": height, "crop_offset_x": 0, "crop_offset_y": 0}
    if any(film.number(key, size) != size for key, size in whole.items()):
        materials.lose("crops of the film: the whole film in their place", film.name or film.type)
    return FilmSettings(width, height, max_depth=depth if depth > 0 else FilmSettings.max_depth)


def _camera(sensor: Plugin, film: FilmSettings, materials: Materials) -> dict[str, Any]:
    """The camera as a table of a scene file."""
    matrix = sensor.matrix()
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0).clip(1e-12)
    if np.linalg.det(axes) < 0.0:
        materials.lose("mirrored sensors: the picture is not mirrored", sensor.name or sensor.type)
    if any(sensor.number(f"principal_point_offset_{axis}", 0.0) for axis in "xy"):
        materials.lose("principal points outside the middle: the middle in their place", sensor.name or sensor.type)
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
