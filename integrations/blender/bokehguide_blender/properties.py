"""The settings of a scene's renders."""

from __future__ import annotations

import bpy


class BokehguideSettings(bpy.types.PropertyGroup):
    """Settings of bokehguide, `scene.bokehguide`."""

    samples: bpy.props.IntProperty(name="Samples", description="Samples per pixel", default=256, min=1, max=65536)
    viewport_samples: bpy.props.IntProperty(
        name="Viewport Samples",
        description="Samples per pixel at which a viewport in Rendered shading rests",
        default=32,
        min=1,
        max=65536,
    )
    seed: bpy.props.IntProperty(name="Seed", description="Seed of the random numbers", default=0, min=0)
    time_limit: bpy.props.FloatProperty(
        name="Time Limit",
        description="Seconds after which no sample begins; 0 for none",
        default=0.0,
        min=0.0,
        subtype="TIME_ABSOLUTE",
    )
    max_bounces: bpy.props.IntProperty(name="Max Bounces", description="Bounces of a path", default=8, min=0, max=1024)
    use_denoise: bpy.props.BoolProperty(name="Denoise", description="Denoise the picture with Open Image Denoise", default=False)
    use_pass_albedo: bpy.props.BoolProperty(
        name="Albedo", description="Deliver the base colour of the first surface", default=False
    )


def register() -> None:
    bpy.utils.register_class(BokehguideSettings)
    bpy.types.Scene.bokehguide = bpy.props.PointerProperty(type=BokehguideSettings)


def unregister() -> None:
    del bpy.types.Scene.bokehguide
    bpy.utils.unregister_class(BokehguideSettings)
