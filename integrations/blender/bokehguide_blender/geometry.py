"""The meshes and materials of a scene, as a .glb file of Blender's glTF exporter. Runs in the main thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy

EXPORT = {
    "export_format": "GLB",
    "export_yup": True,
    "export_apply": True,
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
    "use_renderable": True,
    "check_existing": False,
}
"""Options of the exporter; those that a release of Blender lacks are left out."""


def export_geometry(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, path: Path) -> None:
    """Write the renderable objects of a view layer in the axes of glTF."""
    if not hasattr(bpy.types, "EXPORT_SCENE_OT_gltf"):
        bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
    known = {each.identifier for each in bpy.ops.export_scene.gltf.get_rna_type().properties}
    options = {name: value for name, value in EXPORT.items() if name in known}
    with bpy.context.temp_override(scene=scene, view_layer=layer), render_levels(scene):
        bpy.ops.export_scene.gltf(filepath=str(path), **options)


@contextmanager
def render_levels(scene: bpy.types.Scene) -> Iterator[None]:
    """A context in which the viewport shows the modifiers of the render, which the exporter reads."""
    changed = []
    for item in scene.objects:
        for modifier in item.modifiers:
            for shown, rendered in (("levels", "render_levels"), ("show_viewport", "show_render")):
                if hasattr(modifier, rendered) and getattr(modifier, shown) != getattr(modifier, rendered):
                    changed.append((modifier, shown, getattr(modifier, shown)))
                    setattr(modifier, shown, getattr(modifier, rendered))
    try:
        yield
    finally:
        for modifier, shown, value in changed:
            setattr(modifier, shown, value)
