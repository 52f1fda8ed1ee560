"""The panels of the engine, and Blender's panels that also serve the engine."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

ENGINE = "BOKEHGUIDE"
EEVEE = {"BLENDER_EEVEE", "BLENDER_EEVEE_NEXT"}
SHARED = (
    "DATA_PT_EEVEE_light",
    "DATA_PT_camera_dof",
    "DATA_PT_camera_dof_aperture",
    "DATA_PT_preview",
    "DATA_PT_spot",
    "EEVEE_MATERIAL_PT_context_material",
    "EEVEE_MATERIAL_PT_surface",
    "EEVEE_WORLD_PT_surface",
    "MATERIAL_PT_preview",
)
"""Panels of EEVEE with settings that bokehguide uses."""
UNUSED = ("RENDER_PT_simplify", "VIEWLAYER_PT_filter", "RENDER_PT_freestyle")
"""Panels of every engine with settings that bokehguide does not use."""


class Panel(bpy.types.Panel):
    """A panel of the render properties."""

    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "render"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == ENGINE


class BOKEHGUIDE_PT_sampling(Panel):
    bl_label = "Sampling"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        for name in ("samples", "viewport_samples", "time_limit", "seed", "max_bounces", "use_denoise"):
            self.layout.prop(context.scene.bokehguide, name)
        self.layout.prop(context.scene.render, "preview_pixel_size", text="Viewport Pixel Size")


class BOKEHGUIDE_PT_film(Panel):
    bl_label = "Film"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(context.scene.render, "film_transparent", text="Transparent World")


class BOKEHGUIDE_PT_passes(Panel):
    bl_label, bl_context = "Passes", "view_layer"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(context.view_layer, "use_pass_z")
        self.layout.prop(context.view_layer, "use_pass_normal")
        self.layout.prop(context.scene.bokehguide, "use_pass_albedo")
        column = self.layout.column(heading="Cryptomatte", align=True)
        column.prop(context.view_layer, "use_pass_cryptomatte_object", text="Object")
        column.prop(context.view_layer, "use_pass_cryptomatte_material", text="Material")


class BOKEHGUIDE_PT_light_groups(Panel):
    bl_label, bl_context = "Light Groups", "view_layer"

    def draw(self, context: bpy.types.Context) -> None:
        layer, row = context.view_layer, self.layout.row()
        row.template_list("UI_UL_list", "lightgroups", layer, "lightgroups", layer, "active_lightgroup_index", rows=3)
        column = row.column(align=True)
        column.operator("scene.view_layer_add_lightgroup", icon="ADD", text="")
        column.operator("scene.view_layer_remove_lightgroup", icon="REMOVE", text="")


class LightGroupPanel(Panel):
    """The light group of an object or of a world."""

    bl_label = "Light Group"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        owner = getattr(context, self.bl_context)
        self.layout.prop_search(owner, "lightgroup", context.view_layer, "lightgroups", text="Light Group")


class BOKEHGUIDE_PT_object_light_group(LightGroupPanel):
    bl_context = "object"


class BOKEHGUIDE_PT_world_light_group(LightGroupPanel):
    bl_context = "world"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and context.world is not None


CLASSES = (
    BOKEHGUIDE_PT_sampling,
    BOKEHGUIDE_PT_film,
    BOKEHGUIDE_PT_passes,
    BOKEHGUIDE_PT_light_groups,
    BOKEHGUIDE_PT_object_light_group,
    BOKEHGUIDE_PT_world_light_group,
)


def shared_panels() -> Iterator[type[bpy.types.Panel]]:
    """Blender's panels that also serve the engine: those of every engine, and some of EEVEE."""
    for panel in bpy.types.Panel.__subclasses__():
        engines = getattr(panel, "COMPAT_ENGINES", ())
        general = "BLENDER_RENDER" in engines and panel.__name__ not in UNUSED
        if general or (panel.__name__ in SHARED and EEVEE & set(engines)):
            yield panel


def register() -> None:
    for each in CLASSES:
        bpy.utils.register_class(each)
    for panel in shared_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    for panel in bpy.types.Panel.__subclasses__():
        getattr(panel, "COMPAT_ENGINES", set()).discard(ENGINE)
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
