"""Mitsuba XML files as scenes: shapes, BSDFs, emitters and the sensor, as far as they have counterparts."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.losses import UNKNOWN_NAMES, unknown_name
from bokehguide.scene.mitsuba_xml.cameras import SENSORS, read_camera, read_film
from bokehguide.scene.mitsuba_xml.lights import read_emission, read_lights
from bokehguide.scene.mitsuba_xml.materials import Materials
from bokehguide.scene.mitsuba_xml.properties import unknown_properties
from bokehguide.scene.mitsuba_xml.shapes import read_shape
from bokehguide.scene.mitsuba_xml.tree import Plugin, read_tree
from bokehguide.scene.mitsuba_xml.upright import scene_from_world
from bokehguide.scene.overrides import ChosenCamera, Overrides, override_camera
from bokehguide.scene.shapes import instanced, reversed_mesh, transformed
from bokehguide.scene.types import Mesh, Scene
from bokehguide.scene.validation import check_meshes, check_triangles

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
    environment, suns = read_lights(root, path, files, materials, meshes, world)
    turned = not np.array_equal(world, np.eye(4))
    if not meshes:
        raise BokehguideError(f"{path}: holds no shapes that can be drawn; give a scene with some")
    for plugin, key, near in unknown_properties(root):
        materials.lose(UNKNOWN_NAMES, unknown_name(plugin.place.removeprefix(f"{path}: "), key, near))
    film = read_film(sensors[0], root, materials)
    chosen = override_camera(read_camera(sensors[0], film, materials, world), overrides, str(path), files, written=True)
    scene = Scene(
        name=path.stem,
        camera=chosen.camera,
        meshes=tuple(transformed(mesh, world) for mesh in meshes) if turned else tuple(meshes),
        materials=tuple(materials.all),
        film=film,
        environment=environment,
        suns=tuple(suns),
        warnings=tuple(materials.lost.lines(path.name)),
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
        emission = read_emission(emitters[0], materials) if emitters else {}
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
