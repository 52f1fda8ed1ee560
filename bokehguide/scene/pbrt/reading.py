"""pbrt files as scenes: shapes, materials, lights and the camera, as far as they have counterparts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.gltf.lights import default_radius
from bokehguide.scene.overrides import ChosenCamera, Overrides, override_camera
from bokehguide.scene.pbrt.cameras import read_camera, read_film, world_matrix
from bokehguide.scene.pbrt.contents import Contents, Shape
from bokehguide.scene.pbrt.curves import curves_mesh, detail, segment_count, triangle_count
from bokehguide.scene.pbrt.lights import Lights, area_emission
from bokehguide.scene.pbrt.materials import Materials, Opacity
from bokehguide.scene.pbrt.older import upgrade
from bokehguide.scene.pbrt.older_materials import OlderMaterials
from bokehguide.scene.pbrt.parser import parse
from bokehguide.scene.pbrt.quadrics import SEGMENTS
from bokehguide.scene.pbrt.shapes import QUADRICS, Read, read_shape
from bokehguide.scene.pbrt.textures import Textures, constant
from bokehguide.scene.shapes import MOST_SPHERES, instanced, reversed_mesh, surface_area, transformed
from bokehguide.scene.tables import did_you_mean
from bokehguide.scene.types import Mesh, Scene
from bokehguide.scene.validation import check_meshes, check_triangles

SPLIT_DEPTH = 3
"""Logarithm of the pieces of a segment of a curve, each of which is a shape of pbrt."""


def read_pbrt(path: Path, overrides: Overrides, files: SceneFiles) -> tuple[Scene, ChosenCamera]:
    """The scene of a file, and its camera with `overrides`. The scene's warnings tell what is lost.

    files: the files that the scene may name. Raises BokehguideError for an unreadable file, values out of range, and a scene
    without a camera or without shapes.
    """
    contents = parse(path, files)
    if contents.camera is None:
        raise BokehguideError(f'{path}: has no camera; add Camera "perspective" before WorldBegin')
    if contents.older:
        upgrade(contents, path.parent, files)
    world, film = world_matrix(contents), read_film(contents)
    shapes = _Shapes(path, contents, files)
    meshes = shapes.placed(world)
    if not meshes:
        lost = contents.lost.lines(end="left out")
        known = f" ({lost[0]})" if lost else ""
        raise BokehguideError(f"{path}: holds no shapes that can be drawn{known}; give a scene with some")
    lights = Lights(contents, shapes.materials, shapes.textures, world, default_radius(meshes))
    lights.read(path.parent, files)
    chosen = override_camera(read_camera(contents, film, path.parent, files), overrides, str(path), files, written=True)
    contents.note_misspelt()
    scene = Scene(
        name=path.name.partition(".")[0],
        camera=chosen.camera,
        meshes=(*meshes, *lights.meshes),
        materials=tuple(shapes.materials.all),
        film=film,
        environment=lights.environment,
        suns=tuple(lights.suns),
        warnings=tuple(contents.lost.lines(path.name)),
    )
    return scene, chosen


@dataclass
class _Shapes:
    """The shapes of a scene as meshes."""

    path: Path
    contents: Contents
    files: SceneFiles

    def __post_init__(self) -> None:
        folder = self.path.parent
        self.textures = Textures(self.contents, folder, self.files)
        kind = OlderMaterials if self.contents.older else Materials
        self.materials = kind(self.contents, self.textures, folder, self.files)
        self._triangles = 0
        self._named: Counter[str] = Counter()
        uses = Counter(instance.name for instance in self.contents.instances)
        used = [(self.contents.shapes, 1), *((shapes, uses[name]) for name, shapes in self.contents.objects.items())]
        quadrics = sum(number * sum(shape.parameters.kind in QUADRICS for shape in shapes) for shapes, number in used)
        self._segments = SEGMENTS >> sum(quadrics > most for most in MOST_SPHERES)
        self._detail = detail(sum(number * _segments_of(shapes) for shapes, number in used))

    def placed(self, world: np.ndarray) -> list[Mesh]:
        """All shapes and instances in the scene's space. world: from pbrt's world."""
        meshes: list[Mesh] = []
        for shapes in _groups(self.contents.shapes):
            self._add(meshes, self._mesh(shapes, world, shapes[0].light is not None), shapes[0])
        for name, matrices in self._uses(world).items():
            for shapes in _groups(self.contents.objects[name]):
                shape = shapes[0]
                if shape.light is not None:
                    self.contents.lose("emission of instances: pbrt has none either", printable(name))
                mesh = self._mesh(shapes, np.eye(4), False, printable(name))
                if mesh is not None:
                    total = self._triangles + len(mesh.triangles) * len(matrices)
                    check_triangles(total, str(shape.parameters.place), self.files.most_triangles)
                    self._add(meshes, instanced(mesh, matrices), shape)
        return meshes

    def _add(self, meshes: list[Mesh], mesh: Mesh | None, shape: Shape) -> None:
        """Append a mesh, within the limits of the scene."""
        if mesh is not None:
            meshes.append(mesh)
            check_meshes(len(meshes), str(shape.parameters.place), self.files.most_meshes)
            self._triangles += len(mesh.triangles)
            check_triangles(self._triangles, str(shape.parameters.place), self.files.most_triangles)

    def _uses(self, world: np.ndarray) -> dict[str, np.ndarray]:
        """The matrices `[N, 4, 4]` of the instances of each object."""
        uses: dict[str, list[np.ndarray]] = {}
        for instance in self.contents.instances:
            if instance.name not in self.contents.objects:
                known = did_you_mean(instance.name, self.contents.objects) if self.contents.objects else "define it"
                instance.place.fail(f"ObjectInstance {printable(instance.name)!r}: no such object; {known}")
            uses.setdefault(instance.name, []).append(world @ instance.matrix)
        return {name: np.stack(matrices) for name, matrices in uses.items()}

    def _mesh(self, shapes: Sequence[Shape], outer: np.ndarray, emits: bool, instanced_as: str = "") -> Mesh | None:
        """A shape, or curves that share all but their points, under `outer` and their own matrices; None for invisible ones.

        instanced_as: the name of the object, "" without one.
        """
        shape = shapes[0]
        parameters = shape.parameters
        opacity = self._opacity(shape)
        if opacity is not None and opacity.value.constant and not opacity.value.image.max() > 0.0:
            if not emits:
                return None
            self.contents.lose("invisible area lights: visible ones in their place", parameters.place.short)
            opacity = None
        with located(str(parameters.place)):
            read, matrix = self._read(shapes, outer)
            if read is None:
                self.contents.lose(f"shapes of the type {printable(parameters.kind)}: left out", parameters.place.short)
                return None
            if "displacement" in parameters:
                self.contents.lose("displacement and bump maps: left out", parameters.place.short)
            turned = shape.reverse != self.materials.turned(shape)
            mesh = transformed(reversed_mesh(read.mesh) if turned else read.mesh, matrix)
        emission = {}
        if emits and shape.light is not None:
            if shape.light.kind != "diffuse":
                shape.light.place.fail(f'an area light of the type {printable(shape.light.kind)!r}; give "diffuse"')
            area = surface_area(mesh) / max(read.count, 1)
            emission = area_emission(shape.light, area, self.contents, self.textures, self.path.parent, self.files)
        index = self.materials.index(shape, opacity, emission)
        if index is None:
            return None
        name, groups = self._names(shape, instanced_as)
        return replace(mesh, material=index, name=name, groups=groups)

    def _read(self, shapes: Sequence[Shape], outer: np.ndarray) -> tuple[Read | None, np.ndarray]:
        """A shape, or curves as one mesh, and the matrix under which they are; None for a kind without a counterpart."""
        parameters, segments = shapes[0].parameters, _segments_of(shapes)
        if not segments:
            return read_shape(parameters, self.path.parent, self.files, self._segments), outer @ shapes[0].matrix
        total = self._triangles + triangle_count(segments, *self._detail)
        check_triangles(total, str(parameters.place), self.files.most_triangles)
        if any(shape.parameters.text("type", "flat") == "flat" for shape in shapes):
            self.contents.lose("flat curves: tubes in their place", parameters.place.short)
        return Read(curves_mesh(shapes, *self._detail), segments << SPLIT_DEPTH), outer

    def _names(self, shape: Shape, instanced_as: str) -> tuple[str, tuple[str, ...]]:
        """The name of a mesh, and names that it shares with other meshes.

        The name is that of its file, of its object, or of its kind with a named material, and a number from the second use on.
        """
        parameters = shape.parameters
        file = Path(parameters.text("filename")).name.partition(".")[0] if parameters.kind == "plymesh" else ""
        material = f" {shape.material}" if isinstance(shape.material, str) else ""
        shared = printable(file or instanced_as or f"{parameters.kind}{material}")
        self._named[shared] += 1
        number = self._named[shared]
        groups = dict.fromkeys(name for name in (shared, printable(parameters.kind), instanced_as) if name)
        return shared if number == 1 else f"{shared} {number}", tuple(groups)

    def _opacity(self, shape: Shape) -> Opacity | None:
        """The opacity of a shape, None for opaque ones."""
        parameters = shape.parameters
        name = parameters.texture("alpha")
        if name is not None:
            return Opacity(self.textures.scalar(parameters, "alpha", 1.0), name)
        alpha = min(max(parameters.number("alpha", 1.0), 0.0), 1.0)
        return None if alpha == 1.0 else Opacity(constant(alpha), alpha)


def _segments_of(shapes: Iterable[Shape]) -> int:
    """The segments of all curves among `shapes`."""
    return sum(segment_count(shape.parameters) for shape in shapes if shape.parameters.kind == "curve")


def _groups(shapes: Iterable[Shape]) -> list[list[Shape]]:
    """Each shape by itself, and curves that share material, light, side and opacity together."""
    groups: dict[object, list[Shape]] = {}
    for shape in shapes:
        key: object = id(shape)
        if shape.parameters.kind == "curve":
            source = shape.material if isinstance(shape.material, str) else id(shape.material)
            alpha = shape.parameters.values.get("alpha")
            key = (source, id(shape.light), shape.reverse, None if alpha is None else tuple(alpha.values))
        groups.setdefault(key, []).append(shape)
    return list(groups.values())
