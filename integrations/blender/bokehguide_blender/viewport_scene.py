"""The scene file of a viewport, which follows the changes of the scene."""

from __future__ import annotations

import time
from pathlib import Path

import bpy

from .camera import camera_table
from .geometry import SURFACES, export_visible
from .glb import complete_glb
from .light_groups import LightGroups
from .materials import converted_textures, simple_materials
from .scene_export import scene_tables, write_scene

PAUSE = 0.3
"""Seconds without a change after which the scene is exported, so that a drag is not interrupted."""
ORIGIN = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
FOV, SIZE = 40.0, (64, 64)
"""Camera and frame of the scene file, which each view replaces."""
KEPT = 2
"""Number of the latest scene files and models that stay: bokehguide may read the last but one."""


class ViewportScene:
    """Writes the scene of a viewport into a folder whenever it has changed.

    path: of the latest scene file, None before the first. warnings: of this file. waiting: whether changes wait for their export.
    """

    def __init__(self, folder: Path):
        self.path: Path | None = None
        self.warnings: list[str] = []
        self._folder, self._geometry = folder, folder / "geometry-0.glb"
        self._count = 0
        self._due = 0.0
        self.waiting = self._geometry_changed = True
        self._has_meshes = False
        self._names: set[str] = set()

    def note(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Take note of the updates of a dependency graph."""
        ids = [update.id for update in depsgraph.updates]
        if ids and all(_is_camera(each) for each in ids):  # the camera is a part of the view
            return
        self.waiting, self._due = True, time.monotonic() + PAUSE
        self._geometry_changed |= not all(_keeps_geometry(each) for each in ids)

    @property
    def due(self) -> bool:
        """Whether it is time to export the scene."""
        return self.waiting and time.monotonic() >= self._due

    def export(self, depsgraph: bpy.types.Depsgraph) -> bool:
        """Write the scene in the main thread; returns whether the file is another one. Raises RenderError."""
        self.waiting = False
        before = self.path.read_bytes() if self.path else None
        names = {each.object.original.name_full for each in depsgraph.object_instances if each.object.type in SURFACES}
        other_geometry = self._geometry_changed or names != self._names
        if other_geometry:
            other_geometry = self._export_geometry(depsgraph)
            self._geometry_changed, self._names = False, names
        self.warnings = []
        tables = scene_tables(
            depsgraph, camera_table(ORIGIN, FOV), SIZE, lambda _: False, self._folder, LightGroups([]), self.warnings
        )
        path = self._numbered("scene", ".toml")
        write_scene(tables, {"": self._geometry} if self._has_meshes else {}, path)
        if not other_geometry and path.read_bytes() == before:
            path.unlink()
            return False
        self.path = path
        return True

    def _export_geometry(self, depsgraph: bpy.types.Depsgraph) -> bool:
        """Write the meshes; returns whether they are others than those before."""
        path, before = self._numbered("geometry", ".glb"), self._geometry
        scene = depsgraph.scene.original
        export_visible(scene, scene.view_layers[depsgraph.view_layer.name], path)
        self._has_meshes = complete_glb(path, simple_materials(depsgraph), converted_textures(depsgraph))
        if before.exists() and before.read_bytes() == path.read_bytes():
            path.unlink()
            return False
        self._geometry = path
        return True

    def _numbered(self, stem: str, suffix: str) -> Path:
        """A new path. Old files of this kind are removed."""
        self._count += 1
        known = sorted(self._folder.glob(f"{stem}-*{suffix}"), key=lambda path: int(path.stem.rpartition("-")[2]))
        for path in known[:-KEPT]:
            path.unlink()
        return self._folder / f"{stem}-{self._count}{suffix}"


def _is_camera(item: bpy.types.ID) -> bool:
    """Whether an updated data block is a camera or its object."""
    return isinstance(item, bpy.types.Camera) or (isinstance(item, bpy.types.Object) and item.type == "CAMERA")


def _keeps_geometry(item: bpy.types.ID) -> bool:
    """Whether an update of a data block leaves meshes and materials as they are.

    A node tree is updated together with its material or world. An update of the scene alone may hide objects, or only
    select them.
    """
    if isinstance(item, bpy.types.Object):
        return item.type in ("CAMERA", "LIGHT")
    return isinstance(item, (bpy.types.Camera, bpy.types.Light, bpy.types.World, bpy.types.Scene, bpy.types.ShaderNodeTree))
