"""Mitsuba XML files as scenes: shapes, BSDFs, emitters and the sensor, as far as they have counterparts."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.checks import located
from bokehguide.scene.environments import constant_radiance, load_environment_map
from bokehguide.scene.files import SceneFiles, require_map
from bokehguide.scene.losses import UNKNOWN_NAMES, loss_lines, unknown_name
from bokehguide.scene.mitsuba_xml.materials import Materials, color_of, is_image, kind_of
from bokehguide.scene.mitsuba_xml.properties import unknown_properties
from bokehguide.scene.mitsuba_xml.shapes import read_shape
from bokehguide.scene.mitsuba_xml.sunsky import read_sunsky
from bokehguide.scene.mitsuba_xml.tree import Plugin, read_tree
from bokehguide.scene.mitsuba_xml.upright import scene_from_world
from bokehguide.scene.overrides import ChosenCamera, Overrides, override_camera
from bokehguide.scene.shapes import instanced, reversed_mesh, spheres, transformed
from bokehguide.scene.types import Cone, Environment, FilmSettings, LightSizes, Material, Mesh, Scene, Sun, Vector, as_vector
from bokehguide.scene.validation import check_meshes, check_triangles

POINT_RADIUS = 0.01
"""Metres; the radius of the spheres that stand for point lights, as for those of glTF."""
UNBOUNDED = 64
"""Segments of the longest path of an integrator without a limit; Russian roulette ends nearly all paths before."""
SENSORS = ("thinlens", "perspective")
TURNED = "world: turned so that the environment map stands upright"


def read_mitsuba(path: Path, overrides: Overrides, files: SceneFiles) -> tuple[Scene, ChosenCamera]:
    """The scene of an XML file, and its camera with `overrides`. The scene's warnings tell what is lost.

    files: the files that the scene may name. Raises BokehguideError for a missing Mitsuba, an unreadable file, values out of
    range, and a scene without a sensor or without shapes.
    """
    root = read_tree(path, files)
    sensors = [sensor for sensor in root.inner("sensor") if sensor.type in SENSORS]
    if not sensors:
        raise BokehguideError(f"{path}: has no sensor of the type {' or '.join(SENSORS)}; add one")
    materials, world = Materials(path, files), scene_from_world(root)
    meshes = _meshes(root, path, files, materials)
    environment, suns = _lights(root, path, files, materials, meshes, world)
    turned = not np.array_equal(world, np.eye(4))
    if not meshes:
        raise BokehguideError(f"{path}: holds no shapes that can be drawn; give a scene with some")
    for plugin, key, near in unknown_properties(root):
        materials.lose(UNKNOWN_NAMES, unknown_name(plugin.place.removeprefix(f"{path}: "), key, near))
    film = _film(sensors[0], root, materials)
    chosen = override_camera(_camera(sensors[0], film, materials, world), overrides, str(path), files, written=True)
    scene = Scene(
        name=path.stem,
        camera=chosen.camera,
        meshes=tuple(transformed(mesh, world) for mesh in meshes) if turned else tuple(meshes),
        materials=tuple(materials.all),
        film=film,
        environment=environment,
        suns=tuple(suns),
        warnings=tuple(loss_lines(materials.lost, path.name)),
        supported=(f"{path.name}: {TURNED}",) if turned else (),
    )
    return scene, chosen


def _meshes(root: Plugin, path: Path, files: SceneFiles, materials: Materials) -> list[Mesh]:
    """All shapes with their materials."""
    meshes: list[Mesh] = []
    triangles, unnamed = 0, Counter[str]()
    for shape, matrices in _drawn(root):
        name, groups = _names(shape, unnamed)
        with located(shape.place):
            found = read_shape(shape, path, files)
        if found is None:
            materials.lose(f"shapes of the type {shape.type}: left out", name)
            continue
        bsdfs, emitters = shape.inner("bsdf"), [each for each in shape.inner("emitter") if each.type == "area"]
        emission = _emission(emitters[0], materials) if emitters else {}
        bsdf = bsdfs[0] if bsdfs else None
        if shape.inner("medium"):
            materials.lose("media: left out", name)
        if bsdf is not None and bsdf.type == "null" and not emission:
            continue  # the invisible boundary of a medium
        if materials.turned(bsdf):
            if emission:
                materials.lose("glass in a denser medium that emits: the glass is the denser one", name)
            else:
                found = [reversed_mesh(mesh) for mesh in found]
        index = materials.index(bsdf, emission)
        check_meshes(len(meshes) + len(found), shape.place, files.most_meshes)
        triangles += (1 if matrices is None else len(matrices)) * sum(len(mesh.triangles) for mesh in found)
        check_triangles(triangles, shape.place, files.most_triangles)
        found = found if matrices is None else [instanced(mesh, matrices) for mesh in found]
        meshes += [replace(mesh, material=index, name=name, groups=groups) for mesh in found]
    return meshes


def _drawn(root: Plugin) -> list[tuple[Plugin, np.ndarray | None]]:
    """The shapes that can be seen. Shapes of a group come with the transforms `[N, 4, 4]` of the group's instances."""
    drawn: list[tuple[Plugin, np.ndarray | None]] = []
    uses: dict[int, tuple[Plugin, list[np.ndarray]]] = {}
    for shape in root.inner("shape"):
        groups = [each for each in shape.inner("shape") if each.type == "shapegroup"]
        if shape.type == "instance":
            for group in groups:
                uses.setdefault(id(group), (group, []))[1].append(shape.matrix())
        elif shape.type != "shapegroup":
            drawn.append((shape, None))
    return drawn + [(shape, np.stack(matrices)) for group, matrices in uses.values() for shape in group.inner("shape")]


def _names(shape: Plugin, unnamed: Counter[str]) -> tuple[str, tuple[str, ...]]:
    """The name of a shape, and a name that it shares with other shapes.

    Without an `id`, the name is that of its file or its type, with a number from the second use on. unnamed: the uses so far.
    """
    file = shape.values.get("filename")
    shared = printable(Path(file).stem if isinstance(file, str) else "") or shape.type
    if shape.name:
        return shape.name, (shared,)
    unnamed[shared] += 1
    return shared if unnamed[shared] == 1 else f"{shared} {unnamed[shared]}", (shared,)


def _emission(emitter: Plugin, materials: Materials) -> dict[str, Any]:
    """The fields of `Material` of an area emitter."""
    radiance = emitter.values.get("radiance")
    if is_image(radiance):
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
    root: Plugin, path: Path, files: SceneFiles, materials: Materials, meshes: list[Mesh], world: np.ndarray
) -> tuple[Environment | None, list[Sun]]:
    """Environment and suns; appends spheres for point lights to `meshes`. world: see `scene_from_world`."""
    environment, suns = None, []
    for emitter in root.inner("emitter"):
        name = emitter.name or emitter.type
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
    away = emitter.matrix()[:3, 2]
    direction = emitter.values.get("direction", tuple(away))
    if not isinstance(direction, tuple) or len(direction) != 3 or not any(direction):
        emitter.fail("direction", "is no direction; give x, y and z")
    unit = -np.array(direction) / np.linalg.norm(direction)
    return Sun(as_vector(world[:3, :3] @ unit), LightSizes.sun_angle, _light(emitter, "irradiance", materials))


def _point(emitter: Plugin, materials: Materials, world: np.ndarray) -> Mesh:
    """A point light or a spotlight as a small sphere of the same intensity, before the turn of the world."""
    position = emitter.values.get("position", tuple(emitter.matrix()[:3, 3]))
    if not isinstance(position, tuple) or len(position) != 3:
        emitter.fail("position", "is no point; give x, y and z")
    emission = as_vector(channel / (math.pi * POINT_RADIUS**2) for channel in _light(emitter, "intensity", materials))
    name, cone = emitter.name or f"{emitter.type} light", _cone(emitter, materials, world) if emitter.type == "spot" else None
    materials.all.append(Material(name, (0.0, 0.0, 0.0), specular=0.0, emission=emission, emission_cone=cone))
    sphere = spheres(np.array([position]), np.array([POINT_RADIUS]), len(materials.all) - 1)
    return replace(sphere, name=name)


def _cone(emitter: Plugin, materials: Materials, world: np.ndarray) -> Cone:
    """The cone of a spotlight about its z axis.

    Mitsuba's falloff from `beam_width` to `cutoff_angle` is linear in the angle. The inner angle of the cone gives the same flux:
    with cosines h and l of its angles, the integral of the falloff over the cosine is 1 - 2h/3 - l/3.
    """
    if "texture" in emitter.values:
        materials.lose("textures of spotlights: left out", emitter.name or emitter.type)
    outer = min(max(emitter.number("cutoff_angle", 20.0), 0.1), 90.0)
    width = min(max(emitter.number("beam_width", 0.75 * outer), 0.0), outer - 0.05)
    cutoff, beam = math.radians(outer), math.radians(width)
    high = 1.5 * (math.sin(cutoff) - math.sin(beam)) / (cutoff - beam) - 0.5 * math.cos(cutoff)
    inner = min(math.degrees(math.acos(min(high, 1.0))), outer - 0.01)
    axis = world[:3, :3] @ emitter.matrix()[:3, 2]
    if not np.linalg.norm(axis) > 0.0:
        emitter.fail("to_world", "has no direction; give another transform")
    return Cone(as_vector(axis / np.linalg.norm(axis)), inner, outer)


def _film(sensor: Plugin, root: Plugin, materials: Materials) -> FilmSettings:
    """Size of the film, and the depth of the integrator."""
    films = sensor.inner("film")
    film = films[0] if films else sensor
    width, height = (int(film.number(key, size)) if films else size for key, size in (("width", 768), ("height", 576)))
    whole = {"crop_width": width, "crop_height": height, "crop_offset_x": 0, "crop_offset_y": 0}
    if any(film.number(key, size) != size for key, size in whole.items()):
        materials.lose("crops of the film: the whole film in their place", film.name or film.type)
    return FilmSettings(width, height, max_depth=_depth(root))


def _depth(root: Plugin) -> int:
    """The longest path in segments, of the innermost integrator."""
    integrators, depth = root.inner("integrator"), -1
    while integrators:
        depth = 2 if integrators[0].type == "direct" else int(integrators[0].number("max_depth", -1))
        integrators = integrators[0].inner("integrator")
    return depth if depth > 0 else UNBOUNDED


def _camera(sensor: Plugin, film: FilmSettings, materials: Materials, world: np.ndarray) -> dict[str, Any]:
    """The camera as a table of a scene file."""
    matrix = world @ sensor.matrix()
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
