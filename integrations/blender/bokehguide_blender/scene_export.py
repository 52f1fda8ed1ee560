"""A scene file of the scene that Blender renders."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from .axes import Vector
from .camera import in_frame, read_camera, read_framing
from .framing import Framing
from .geometry import export_rendered, rendered_objects
from .glb import complete_glb, split_glb
from .light_groups import LightGroups
from .lights import read_lights
from .main_thread import in_main_thread
from .materials import converted_textures, material_warnings, simple_materials
from .messages import RenderError
from .scene_losses import render_warnings, scene_warnings
from .toml_text import dumps
from .world import read_world

GEOMETRY = "geometry.glb"


@dataclass
class Exported:
    """A scene file, its framing, what it lacks, and its light groups. has_groups: whether a light has a group."""

    path: Path
    framing: Framing
    warnings: list[str]
    groups: LightGroups
    has_groups: bool


def export_scene(engine: bpy.types.RenderEngine, depsgraph: bpy.types.Depsgraph, folder: Path) -> Exported:
    """Write the scene of a render into a folder. Raises RenderError for a scene without a perspective camera."""
    scene, warnings = depsgraph.scene, render_warnings(depsgraph)
    if engine.camera_override is None and scene.camera is None:
        raise RenderError("the scene has no camera; add one, and make it the active camera of the scene")
    camera = (engine.camera_override or scene.camera).evaluated_get(depsgraph)
    framing = read_framing(camera.data, scene.render, (engine.resolution_x, engine.resolution_y), warnings)
    view = read_camera(camera, framing, warnings)
    layer = scene.original.view_layers[depsgraph.view_layer.name]
    rendered = rendered_objects(depsgraph)
    groups = LightGroups.of(layer)
    tables = scene_tables(depsgraph, view, framing.size, lambda each: in_frame(view, framing, each), folder, groups, warnings)
    geometry = folder / GEOMETRY
    in_main_thread(lambda: export_rendered(scene.original, layer, rendered, geometry), engine.test_break)
    path = folder / "scene.toml"
    write_scene(tables, _parts(geometry, depsgraph, groups), path)
    warnings += groups.warnings
    has_groups = any("group" in entry for entry in _entries(tables))
    return Exported(path, framing, warnings, groups, has_groups)


def _parts(geometry: Path, depsgraph: bpy.types.Depsgraph, groups: LightGroups) -> dict[str, Path]:
    """The .glb files by light group, none without meshes."""
    if not complete_glb(geometry, simple_materials(depsgraph), converted_textures(depsgraph)):
        return {}
    items = (instance.object for instance in depsgraph.object_instances)
    grouped = {item.name: groups.key(item.lightgroup) for item in items if groups.key(item.lightgroup)}
    return split_glb(geometry, grouped)


def _entries(tables: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """All tables, and those of arrays."""
    for content in tables.values():
        yield from content if isinstance(content, list) else [content]


def scene_tables(
    depsgraph: bpy.types.Depsgraph,
    view: dict[str, Any],
    size: tuple[int, int],
    seen: Callable[[Vector], bool],
    folder: Path,
    groups: LightGroups,
    warnings: list[str],
) -> dict[str, Any]:
    """The tables of a scene file without its geometry.

    view: the `[camera]` table. size: of the frame in pixels. seen: whether the camera sees a light at this position, of which
    users are warned. folder: for maps of the world.
    """
    scene = depsgraph.scene
    tables: dict[str, Any] = {
        "camera": view,
        "film": {"width": size[0], "height": size[1], "max_depth": scene.bokehguide.max_bounces + 2},
    }
    environment = read_world(scene, folder, groups, warnings)
    if environment is not None:
        tables["environment"] = environment
    tables |= read_lights(depsgraph, seen, groups, warnings)
    warnings += scene_warnings(depsgraph) + material_warnings(depsgraph)
    return tables


def write_scene(tables: dict[str, Any], geometry: Mapping[str, Path], path: Path) -> None:
    """Write a scene file beside its geometry. geometry: files by light group, empty where the scene has none."""
    if geometry:
        tables["object"] = [{"file": file.name} | ({"group": group} if group else {}) for group, file in geometry.items()]
    elif "light" not in tables:
        tables |= _speck(tables["camera"])
    path.write_text(dumps(tables), encoding="utf-8")


def _speck(view: dict[str, Any]) -> dict[str, object]:
    """The tables of a black speck a metre behind the camera: bokehguide renders no scene without a surface."""
    behind = [2.0 * a - b for a, b in zip(view["position"], view["target"])]
    black = {"base_color": (0.0, 0.0, 0.0), "specular": 0.0}
    return {"materials.speck": black, "object": [{"shape": "box", "material": "speck", "scale": 1e-4, "translate": behind}]}
