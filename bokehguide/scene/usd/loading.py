"""USD files as models: meshes, shapes, materials, lights, cameras and the size of the film."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.limits import MAX_SIDE
from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.model import Model, ModelCamera, ModelState
from bokehguide.scene.shapes import instanced, transformed
from bokehguide.scene.types import Environment, FilmSettings, Material, Mesh, Sun
from bokehguide.scene.usd.cameras import read_camera
from bokehguide.scene.usd.domes import DOMES, read_dome
from bokehguide.scene.usd.import_report import supported
from bokehguide.scene.usd.libraries import UsdGeom, UsdLux, UsdRender, UsdSkel
from bokehguide.scene.usd.lights import AREA_LIGHTS, read_area_light, read_sun
from bokehguide.scene.usd.materials import Look, Looks
from bokehguide.scene.usd.meshes import read_mesh
from bokehguide.scene.usd.prims import Placed, drawn_prims
from bokehguide.scene.usd.shapes import read_shape
from bokehguide.scene.usd.skeletons import pose
from bokehguide.scene.usd.stage import Stage, open_stage
from bokehguide.scene.usd.surfaces import Surface, common_level, read_surface, refinable
from bokehguide.scene.validation import check_meshes, check_triangles


def read_usd(path: Path, files: SceneFiles, state: ModelState, binary: bool) -> Model:
    """As `load_usd` in this process. binary: whether layers may be binary. Raises BinaryLayer if they may not, and one is."""
    with open_stage(path, files, state, binary) as opened:
        reader = _Reader(opened)
        pose(opened)
        drawn: list[Placed] = []
        for placed in drawn_prims(opened):
            drawn.append(placed)
            check_meshes(len(drawn), opened.place(placed.prim), files.most_meshes)
        smooth = (len(each.matrices) * refinable(opened, each.prim) for each in drawn if each.prim.IsA(UsdGeom.Mesh))
        reader.level = common_level(sum(smooth))
        for placed in drawn:
            reader.read(placed)
        film, camera = _settings(opened)
    reader.cameras.sort(key=lambda each: each[0] != camera)  # the camera of the settings comes first
    return Model(
        meshes=tuple(reader.meshes),
        materials=tuple(reader.materials),
        emitters=tuple(reader.emitters),
        suns=tuple(reader.suns),
        cameras=tuple(each for _, each in reader.cameras),
        environment=reader.environment,
        film=film,
        supported=tuple(supported(reader, opened, state)),
        warnings=tuple(opened.lost.lines()),
    )


@dataclass
class _Reader:
    """What has been read of a stage. level: refinements of subdivision surfaces. cameras: with the paths of their prims."""

    opened: Stage
    level: int = 0
    meshes: list[Mesh] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    emitters: list[Mesh] = field(default_factory=list)
    suns: list[Sun] = field(default_factory=list)
    cameras: list[tuple[str, ModelCamera]] = field(default_factory=list)
    environment: Environment | None = None

    def __post_init__(self) -> None:
        self.looks = Looks(self.opened)
        self._indices: dict[tuple[int, bool], int] = {}
        self._surfaces: dict[str, Surface | None] = {}
        self._meshes: dict[tuple[str, int, int], Mesh] = {}
        self._triangles = 0

    def read(self, placed: Placed) -> None:
        """Add the contents of a prim."""
        prim, kind = placed.prim, str(placed.prim.GetTypeName())
        self.opened.current = prim
        if prim.IsA(UsdGeom.Camera):
            camera = read_camera(self.opened, placed)
            self.cameras += [] if camera is None else [(str(prim.GetPath()), camera)]
        elif prim.IsA(UsdGeom.Mesh):
            self._mesh(placed)
        elif prim.IsA(UsdGeom.Gprim):
            self._shape(placed)
        elif kind in AREA_LIGHTS:
            self._light(placed)
        elif kind == "DistantLight":
            self.suns += read_sun(self.opened, placed)
        elif kind in DOMES and self.environment is None:
            self.environment = read_dome(self.opened, placed, self.looks.textures)
        elif prim.HasAPI(UsdLux.LightAPI):
            self.opened.lose(f"further dome lights, and lights of the type {kind}: left out", placed.name)

    def _mesh(self, placed: Placed) -> None:
        """A mesh, with a part for each material of its subsets."""
        opened, prim = self.opened, placed.prim
        if prim.IsInstanceProxy() and prim.HasAPI(UsdSkel.BindingAPI):
            opened.lose("skinned meshes of instances: drawn in the pose of their points", placed.name)
        shared = str((prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath())
        if shared not in self._surfaces:
            self._surfaces[shared] = read_surface(opened, prim, self.level)
        surface = self._surfaces[shared]
        if surface is None:
            return
        for number, (subject, faces) in enumerate(_parts(prim, len(surface.control.counts), opened.time)):
            look = self.looks.of(subject) or self.looks.of_color(prim)
            key = shared, number, id(look)
            if key not in self._meshes:
                with located(opened.place(prim)):
                    self._meshes[key] = read_mesh(opened, prim, surface, faces, look)
            if len(self._meshes[key].triangles):
                self._add(placed, self._meshes[key], look)

    def _shape(self, placed: Placed) -> None:
        """A sphere or another shape."""
        shape = read_shape(self.opened, placed.prim)
        if shape is None:
            self.opened.lose(f"prims of the type {placed.prim.GetTypeName()}: left out", placed.name)
            return
        look = self.looks.of(placed.prim) or self.looks.of_color(placed.prim, constant=True)
        if shape.uvs is not None and look.uv_names:
            shape = replace(shape, uvs=np.repeat(shape.uvs, len(look.uv_names), axis=1))
        self._add(placed, shape, look)

    def _light(self, placed: Placed) -> None:
        """A light with a surface."""
        found = read_area_light(self.opened, placed, self.looks.textures)
        if found is not None:
            material, shape = found
            self.materials.append(material)
            self._count(placed, len(shape.triangles) * len(placed.matrices), len(placed.matrices))
            names = {"material": len(self.materials) - 1, "name": placed.name, "groups": placed.groups}
            with located(self.opened.place(placed.prim)):
                self.emitters += [replace(transformed(shape, matrix), **names) for matrix in placed.matrices]

    def _add(self, placed: Placed, mesh: Mesh, look: Look) -> None:
        """Add the instances of a mesh as one mesh in world space."""
        doubled = look.material.emits and bool(UsdGeom.Gprim(placed.prim).GetDoubleSidedAttr().Get(self.opened.time))
        self._count(placed, len(mesh.triangles) * len(placed.matrices), 1)
        names = {"material": self._index(look, doubled), "name": placed.name, "groups": placed.groups}
        with located(self.opened.place(placed.prim)):
            self.meshes.append(replace(instanced(mesh, placed.matrices), **names))

    def _count(self, placed: Placed, triangles: int, meshes: int) -> None:
        """Raise BokehguideError if the stage becomes too large."""
        place, files = self.opened.place(placed.prim), self.opened.files
        check_meshes(len(self.meshes) + len(self.emitters) + meshes, place, files.most_meshes)
        self._triangles += triangles
        check_triangles(self._triangles, place, files.most_triangles)

    def _index(self, look: Look, doubled: bool) -> int:
        """The index of the material of a look."""
        key = (id(look), doubled)  # `looks` keeps each look
        if key not in self._indices:
            self.materials.append(replace(look.material, double_sided=doubled))
            self._indices[key] = len(self.materials) - 1
        return self._indices[key]


def _parts(prim: Any, count: int, time: Any) -> list[tuple[Any, np.ndarray | None]]:
    """The prims that materials of a mesh are bound to, each with the numbers of its polygons; None for all."""
    subsets = [
        each
        for each in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim))
        if each.GetElementTypeAttr().Get() == UsdGeom.Tokens.face and each.GetFamilyNameAttr().Get() == "materialBind"
    ]
    if not subsets:
        return [(prim, None)]
    free, parts = np.ones(count, bool), []
    for subset in subsets:
        faces = np.asarray(subset.GetIndicesAttr().Get(time) or (), np.int64)
        faces = faces[(faces >= 0) & (faces < count)]
        faces = faces[free[faces]]
        free[faces] = False
        parts.append((subset.GetPrim(), faces))
    return [*parts, (prim, np.flatnonzero(free))]


def _settings(opened: Stage) -> tuple[FilmSettings | None, str]:
    """The film of the render settings of a stage, None without one, and the path of their camera."""
    settings = UsdRender.Settings.GetStageRenderSettings(opened.stage)
    if not settings:
        return None, ""
    targets, size = settings.GetCameraRel().GetForwardedTargets(), settings.GetResolutionAttr().Get(opened.time)
    camera = str(targets[0]) if targets else ""
    if not settings.GetResolutionAttr().HasAuthoredValue() or not all(0 < side <= MAX_SIDE for side in size):
        return None, camera
    with located(opened.place(settings.GetPrim())):
        return FilmSettings(width=int(size[0]), height=int(size[1])), camera
