"""The preferences of the add-on."""

from __future__ import annotations

import bpy


class BokehguidePreferences(bpy.types.AddonPreferences):
    """Where bokehguide is installed."""

    bl_idname = __package__

    python: bpy.props.StringProperty(
        name="Python", description="Python interpreter of an environment with bokehguide", subtype="FILE_PATH"
    )

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.prop(self, "python")


def preferences() -> BokehguidePreferences:
    return bpy.context.preferences.addons[__package__].preferences


def register() -> None:
    bpy.utils.register_class(BokehguidePreferences)


def unregister() -> None:
    bpy.utils.unregister_class(BokehguidePreferences)
