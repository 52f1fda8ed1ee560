"""The meshes and materials of a scene, as a .glb file of Blender's glTF exporter. Runs in the main thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy

from .messages import RenderError

EXPORT = {
    "export_format": "GLB",
    "export_yup": True,
    "export_apply": True,
    "export_gn_mesh": True,
    "export_animations": False,
    "export_skins": False,
    "export_morph": False,
    "export_lights": False,
    "export_cameras": False,
    "export_extras": False,
    "export_current_frame": True,
    "export_image_format": "AUTO",
    "export_tangents": False,
    "use_active_scene": True,
    "check_existing": False,
}
"""Options of the exporter; those that a release of Blender lacks are left out."""
SURFACES = {"MESH", "CURVE", "SURFACE", "FONT", "META"}
"""Types of objects that the exporter writes as meshes."""


def rendered_objects(depsgraph: bpy.types.Depsgraph) -> set[str]:
    """The names of the objects that the render shows themselves, not as instances."""
    return {instance.object.original.name_full for instance in depsgraph.object_instances if not instance.is_instance}


def export_rendered(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, rendered: set[str], path: Path) -> None:
    """Write the objects of a render. rendered: as of `rendered_objects`. Raises RenderError as `export_visible`."""
    with as_rendered(scene, rendered):
        _export(scene, layer, path, use_renderable=True)


def export_visible(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, path: Path) -> None:
    """Write the objects of a view layer that the viewport shows, in the axes of glTF.

    Changes nothing in the scene. Raises RenderError where the exporter fails.
    """
    _export(scene, layer, path, use_visible=True)


def _export(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, path: Path, **chosen: bool) -> None:
    if not hasattr(bpy.types, "EXPORT_SCENE_OT_gltf"):
        bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
    known = {each.identifier for each in bpy.ops.export_scene.gltf.get_rna_type().properties}
    options = {name: value for name, value in (EXPORT | chosen).items() if name in known}
    with bpy.context.temp_override(scene=scene, view_layer=layer):
        try:
            bpy.ops.export_scene.gltf(filepath=str(path), **options)
        except RuntimeError as error:  # the exporter's traceback
            reason = [line for line in str(error).splitlines() if line.strip() and not line.startswith("Location:")][-1]
            raise RenderError(
                f"the glTF exporter failed: {reason}; export the scene by File > Export to find the object"
            ) from None


@contextmanager
def as_rendered(scene: bpy.types.Scene, rendered: set[str]) -> Iterator[None]:
    """A context in which the viewport shows the objects and modifiers of the render, which the exporter reads."""
    changed = []

    def change(owner: bpy.types.bpy_struct, name: str, value: object) -> None:
        if getattr(owner, name) != value:
            changed.append((owner, name, getattr(owner, name)))
            setattr(owner, name, value)

    try:
        for item in scene.objects:
            if item.type in SURFACES and item.name_full not in rendered:
                change(item, "hide_render", True)
            for modifier in item.modifiers:
                change(modifier, "show_viewport", modifier.show_render)
                if hasattr(modifier, "render_levels"):
                    change(modifier, "levels", modifier.render_levels)
        yield
    finally:
        for owner, name, value in reversed(changed):
            setattr(owner, name, value)
