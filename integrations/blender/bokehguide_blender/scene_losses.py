"""Settings and objects of a scene that a render leaves out, as warnings."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from .messages import Losses, listed

LOST_TYPES = {"VOLUME", "CURVES", "POINTCLOUD", "GPENCIL", "GREASEPENCIL"}
"""Types of objects that a glTF file cannot have."""
RAYS = ("visible_camera", "visible_diffuse", "visible_glossy", "visible_transmission", "visible_shadow")
PASSES = {"combined", "z", "normal", "cryptomatte_object", "cryptomatte_material", "cryptomatte_accurate"}
"""Passes that a view layer may ask for, by their settings."""
PREFIX = "use_pass_"
WORKING_SPACE = "Linear Rec.709"


def render_warnings(depsgraph: bpy.types.Depsgraph) -> list[str]:
    """Warnings of settings that only a render has."""
    scene, layer = depsgraph.scene, depsgraph.view_layer
    found = {
        "motion blur is ignored": scene.render.use_motion_blur,
        "stereoscopy is ignored; all views are the same picture": scene.render.use_multiview,
        "the material override of the view layer is ignored": layer.material_override is not None,
    }
    return [text for text, lost in found.items() if lost] + _lost_passes(layer)


def _lost_passes(layer: bpy.types.ViewLayer) -> list[str]:
    """A warning of the passes that a render does not deliver."""
    settings = [each for each in layer.bl_rna.properties if each.identifier.startswith(PREFIX)]
    names = [
        each.name for each in settings if each.identifier.removeprefix(PREFIX) not in PASSES and getattr(layer, each.identifier)
    ]
    return [f"passes that bokehguide lacks: {listed(names)}"] if names else []


def scene_warnings(depsgraph: bpy.types.Depsgraph) -> list[str]:
    """Warnings of objects and colours."""
    losses = Losses()
    for instance in depsgraph.object_instances:
        for text in _losses_of(instance.object):
            losses.add(text, instance.object.name)
    space = getattr(getattr(bpy.data, "colorspace", None), "working_space", WORKING_SPACE)  # from Blender 5.0 on
    told = [] if space == WORKING_SPACE else [f"colours of the working space {space} are taken as {WORKING_SPACE}"]
    return told + losses.lines()


def _losses_of(item: bpy.types.Object) -> Iterator[str]:
    """Warnings of the losses of an object; `read_lights` tells the losses of lights."""
    if item.type == "LIGHT":
        return
    if item.type in LOST_TYPES:
        yield "hair, points, grease pencil and volumes are left out"
    elif not all(getattr(item, name) for name in RAYS):
        yield "the ray visibility of objects is ignored"
    if item.is_holdout or item.is_shadow_catcher:
        yield "holdouts and shadow catchers become ordinary objects"
    if any(each.settings.type == "HAIR" and each.settings.render_type == "PATH" for each in item.particle_systems):
        yield "hair of particle systems is left out"
