"""TOML scene files as scenes."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.limits import LARGEST, MAX_KEY_DEPTH
from bokehguide.scene.checks import check_light_group, located, read_exposure
from bokehguide.scene.environments import constant_radiance, load_environment_map
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.model import LightSizes, Model, ModelState
from bokehguide.scene.model_files import load_model, refuse_format
from bokehguide.scene.overrides import ChosenCamera, Overrides, override_camera
from bokehguide.scene.shapes import SHAPES, sphere_subdivisions, transform, transformed, unit_sphere
from bokehguide.scene.tables import ANY, EMITTER_RADIUS, NOT_NEGATIVE, SUN_ANGLE, Table, did_you_mean, is_number
from bokehguide.scene.toml.lights import read_light_tables, read_sun_tables
from bokehguide.scene.toml.materials import read_materials
from bokehguide.scene.toml.placing import in_light_group, place_emitters, place_suns
from bokehguide.scene.types import Environment, FilmSettings, Material, Mesh, Scene, Sun
from bokehguide.scene.units import unit_warning
from bokehguide.scene.validation import check_meshes, check_triangles

SCENE_KEYS = ("camera", "film", "environment", "sun", "light", "lights", "materials", "object")
DEEP_KEY = re.compile(rf"""(?<![\w.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{MAX_KEY_DEPTH}}}""")
BACKSLASH = re.compile(r"Unescaped '\\'|Invalid hex value")
"""Messages of `tomllib` for a path of Windows."""
OBJECT_KEYS = ("name", "shape", "file", "variant", "time", "group", "material", "translate", "rotate", "scale")


def read_scene_file(path: Path, tables: dict[str, Any], overrides: Overrides, files: SceneFiles) -> tuple[Scene, ChosenCamera]:
    """The scene of a `.toml` file with the given tables, and its camera with `overrides`. Paths are relative to the file.

    files: the files that the scene may name. Raises BokehguideError naming file, field, value and
    remedy for invalid input.
    """
    root = Table(tables, str(path), "", SCENE_KEYS)
    if "camera" not in root:
        root.missing("camera", "add [camera] with position and target")
    warnings: list[str] = []
    materials = read_materials(root, files)
    objects = _read_objects(root, files, materials)
    chosen = override_camera(root.values["camera"], overrides, str(path), files, written=True)
    meshes, emissive = read_light_tables(root, len(objects.materials))
    scene = Scene(
        name=path.stem,
        camera=chosen.camera,
        meshes=(*objects.meshes, *meshes),
        materials=(*objects.materials, *emissive),
        film=_read_film(root),
        environment=_read_environment(root, files, warnings),
        suns=(*read_sun_tables(root), *objects.suns),
        warnings=(*objects.lines("warnings"), *_unused_lights(root, objects), *warnings),
        supported=tuple(objects.lines("supported")),
        likely_mistakes=tuple(dict.fromkeys(objects.units)),
    )
    return scene, chosen


def parse_scene_file(path: Path, files: SceneFiles) -> dict[str, Any]:
    """The tables of a TOML file. Raises BokehguideError for a file that is missing, unreadable or no TOML."""
    require_file(path, "scene")
    try:
        text = files.read(path).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
        if DEEP_KEY.search(text):
            raise BokehguideError(f"{path}: not valid TOML: a key of more than {MAX_KEY_DEPTH} parts; give at most so many")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise BokehguideError(f"{path}: not UTF-8 text (byte {error.start}); save it so") from None
    except (ValueError, RecursionError) as error:  # endless numbers or brackets
        remedy = "; write / between the folders of a path" if BACKSLASH.match(str(error)) else ""
        raise BokehguideError(f"{path}: not valid TOML: {error}{remedy}") from None


def _read_film(root: Table) -> FilmSettings:
    """The `[film]` table."""
    table = Table(root.values.get("film", {}), root.file, "film", ("width", "height", "max_depth", "exposure"))
    return FilmSettings(
        width=table.count("width", FilmSettings.width),
        height=table.count("height", FilmSettings.height),
        max_depth=table.count("max_depth", FilmSettings.max_depth),
        exposure=read_exposure(table),
    )


def _read_environment(root: Table, files: SceneFiles, warnings: list[str]) -> Environment | None:
    """The `[environment]` table, None if absent. Appends to `warnings`."""
    if "environment" not in root:
        return None
    keys = ("color", "map", "intensity", "rotation", "visible", "group")
    table = Table(root.values["environment"], root.file, "environment", keys)
    table.exclusive("color", "map")
    if "map" in table:
        radiance, found = load_environment_map(files.named(table, "map"))
        warnings += found
    elif "color" in table:
        radiance = constant_radiance(table.vector("color", None, NOT_NEGATIVE))
    else:
        raise BokehguideError(f"{root.file}: environment: has no light; give color or map")
    intensity = table.number("intensity", 1.0, NOT_NEGATIVE)
    brightest = float(radiance.max()) * intensity
    if not NOT_NEGATIVE.contains(brightest):
        table.fail("intensity", f"makes the brightest radiance {brightest:g}; give less; the maximum is {LARGEST:g}")
    visible = table.flag("visible", Environment.visible)
    group = check_light_group(table, "group")
    return Environment(radiance * np.float32(intensity), table.number("rotation", 0.0), visible, group)


@dataclass
class _Objects:
    """Meshes, suns and materials of the objects of a scene file. Each model is loaded once.

    subdivisions: of spheres. models: by path, state and light group, each with the index of its first material in `materials`.
    unlit: warnings for light groups of objects without lights. units: warnings for models that may have another unit.
    """

    materials: list[Material]
    sizes: LightSizes
    files: SceneFiles
    subdivisions: int
    meshes: list[Mesh] = field(default_factory=list)
    suns: list[Sun] = field(default_factory=list)
    models: dict[tuple[Path, ModelState, str], tuple[Model, int]] = field(default_factory=dict)
    unlit: list[str] = field(default_factory=list)
    units: list[str] = field(default_factory=list)

    def load(self, table: Table) -> tuple[Model, int]:
        """The model of an object's `file`, and the index of its first material."""
        refuse_format(Path(table.text("file")), table.place("file"))
        path = self.files.named(table, "file")
        state = ModelState(table.text("variant") or None, table.number("time", 0.0) if "time" in table else None)
        key = (path, state, check_light_group(table, "group"))
        if key not in self.models:
            model = in_light_group(load_model(path, self.files, self.sizes, state), key[2])
            self.models[key] = model, len(self.materials)
            self.materials.extend(model.materials)
        return self.models[key]

    def lines(self, kind: str) -> list[str]:
        """The lines of the models under `kind`, "warnings" or "supported", each once."""
        return list(dict.fromkeys(line for model, _ in self.models.values() for line in getattr(model, kind)))


def _read_lights(root: Table) -> LightSizes:
    """The `[lights]` table."""
    if isinstance(root.values.get("lights"), list):
        root.fail("lights", "is a list; write [lights] for the sizes of models' lights, or [[light]] for a light")
    table = Table(root.values.get("lights", {}), root.file, "lights", ("radius", "sun_angle"))
    return LightSizes(
        radius=table.number("radius", None, EMITTER_RADIUS) if "radius" in table else None,
        sun_angle=table.number("sun_angle", LightSizes.sun_angle, SUN_ANGLE),
    )


def _unused_lights(root: Table, objects: _Objects) -> list[str]:
    """Warnings for the dome lights of models, for light groups without lights, and for sizes in `[lights]` that no light uses."""
    models = [model for model, _ in objects.models.values()]
    takers = {"radius": (any(model.emitters for model in models), "point and spot lights")}
    takers["sun_angle"] = any(model.suns for model in models), "directional lights"
    given = root.values.get("lights", {})
    unused = [(key, kind) for key, (taken, kind) in takers.items() if key in given and not taken]
    domes = sum(model.environment is not None for model in models)
    left = [f"dome lights of models: {domes} left out, as [environment] lights the scene"] if domes else []
    return left + objects.unlit + [f"lights.{key}: has no effect, as no model has {kind}" for key, kind in unused]


def _read_objects(root: Table, files: SceneFiles, materials: list[Material]) -> _Objects:
    """The `[[object]]` tables. The models' materials follow `materials`."""
    values = root.values.get("object", [])
    if not isinstance(values, list):
        root.fail("object", "is not a list of tables; write [[object]]")
    spheres = sum(isinstance(entry, dict) and entry.get("shape") == "sphere" for entry in values)
    objects = _Objects(list(materials), _read_lights(root), files, sphere_subdivisions(spheres))
    named, triangles = {material.name: index for index, material in enumerate(materials)}, 0
    for number, entry in enumerate(values):
        table = Table(entry, root.file, f"object[{number}]", OBJECT_KEYS)
        material = _named_material(table, named)
        matrix = _read_transform(table)
        surface = _read_surface(table, objects)
        check_meshes(len(objects.meshes) + len(surface), f"{root.file}: {table.path}", files.most_meshes)
        with located(f"{root.file}: {table.path}"):
            placed = [transformed(mesh, matrix) for mesh in surface]
            if material is not None:  # also replaces the model's vertex colours
                placed = [replace(mesh, material=material, colors=None) for mesh in placed]
            if "file" in table:
                model, first = objects.load(table)
                placed += place_emitters(model, first, matrix, objects.materials)
                objects.suns += place_suns(model, matrix)
                objects.units += [] if "scale" in table else unit_warning(Path(table.text("file")), model.meshes)
                if (group := table.text("group")) and not model.suns and not _in_group(placed, objects.materials, group):
                    objects.unlit.append(f"{table.path}.group: has no effect, as the object has no lights")
        objects.meshes += _named(placed, table)
        triangles += sum(len(mesh.triangles) for mesh in placed)
        check_triangles(triangles, f"{root.file}: {table.path}", files.most_triangles)
    return objects


def _in_group(meshes: list[Mesh], materials: list[Material], group: str) -> bool:
    """Whether any surface shines in a light group."""
    return any(materials[mesh.material].light_group == group for mesh in meshes)


def _named(meshes: list[Mesh], table: Table) -> list[Mesh]:
    """The meshes of an object under its name; the names within a model stay valid too.

    The parts of a named model are called as in "left/lid", and the only part has the name of the object alone. A model without a
    name keeps the names of its parts.
    """
    own = table.text("name")
    if not own:
        return [replace(mesh, name=mesh.name or table.path, groups=(*mesh.groups, table.path)) for mesh in meshes]
    several = len({mesh.name for mesh in meshes}) > 1
    names = [f"{own}/{mesh.name}" if several and mesh.name else own for mesh in meshes]
    groups = [(*filter(None, (mesh.name, *mesh.groups)), own) for mesh in meshes]
    return [replace(mesh, name=name, groups=further) for mesh, name, further in zip(meshes, names, groups)]


def _named_material(table: Table, named: dict[str, int]) -> int | None:
    """The index of an object's material, None if absent."""
    name = table.text("material")
    if not name or name in named:
        return named.get(name)
    known = did_you_mean(name, named) if named else "there is no [materials] table"
    return table.fail("material", f"is not a material of this file; {known}")


def _read_surface(table: Table, objects: _Objects) -> list[Mesh]:
    """The meshes of one object in its own space."""
    table.exclusive("shape", "file")
    if "file" in table:
        model, first = objects.load(table)
        return [replace(mesh, material=mesh.material + first) for mesh in model.meshes]
    for key in ("variant", "time", "group"):
        if key in table:
            table.fail(key, "has no effect without a file; leave it out")
    shape = table.text("shape")
    if not shape:
        table.missing("shape", "give a shape or a file")
    if shape not in SHAPES:
        table.fail("shape", f"is not a shape; {did_you_mean(shape, SHAPES)}")
    if "material" not in table:
        table.missing("material", "name one of [materials]")
    return [unit_sphere(objects.subdivisions) if shape == "sphere" else SHAPES[shape]()]


def _read_transform(table: Table) -> np.ndarray:
    """The matrix `[4, 4]` of an object's translate, rotate and scale."""
    uniform = is_number(table.values.get("scale", 1.0))
    scale = (table.number("scale", 1.0),) * 3 if uniform else table.vector("scale", None)
    if 0.0 in scale:
        table.fail("scale", f"flattens the object; give {ANY.remedy} other than 0")
    return transform(table.vector("translate", (0.0, 0.0, 0.0)), table.vector("rotate", (0.0, 0.0, 0.0)), scale)
