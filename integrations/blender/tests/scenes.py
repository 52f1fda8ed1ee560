"""Scenes of the tests, and their pictures by either engine."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
from mathutils import Vector

SIZE = (96, 64)
OUR_SAMPLES = 128


def material(name="grey", color=(0.5, 0.5, 0.5), emission=0.0, **inputs):
    """A Lambertian or emissive material of the Principled BSDF node; inputs: other sockets, with underscores for spaces."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    node = made.node_tree.nodes["Principled BSDF"]
    values = {"Base Color": (*color, 1.0), "Roughness": 1.0, "Specular IOR Level": 0.0}
    if emission:
        values = {
            "Base Color": (0, 0, 0, 1),
            "Emission Color": (*color, 1.0),
            "Emission Strength": emission,
            "Specular IOR Level": 0.0,
        }
    for key, value in (values | {key.replace("_", " "): value for key, value in inputs.items()}).items():
        node.inputs[key].default_value = value
    return made


def mesh(kind, made=None, **options):
    """An object of `bpy.ops.mesh.primitive_KIND_add` with a material."""
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(**options)
    item = bpy.context.object
    item.data.materials.append(made or material())
    return item


def light(kind, location=(0, 0, 2), towards=(0, 0, 0), energy=100.0, **values):
    """A light that shines from `location` to a point."""
    data = bpy.data.lights.new(kind.lower(), kind)
    data.energy = energy
    for key, value in values.items():
        setattr(data, key, value)
    item = bpy.data.objects.new(kind.lower(), data)
    place(item, location, towards)
    return item


def camera(location=(0, -4, 2), towards=(0, 0, 0), lens=50.0, **values):
    """The active camera."""
    data = bpy.data.cameras.new("camera")
    data.lens = lens
    for key, value in values.items():
        setattr(data.dof if hasattr(data.dof, key) else data, key, value)
    item = bpy.data.objects.new("camera", data)
    place(item, location, towards)
    bpy.context.scene.camera = item
    return item


def place(item, location, towards):
    """Put an object into the scene; its -z axis points to `towards`."""
    bpy.context.scene.collection.objects.link(item)
    item.location = location
    item.rotation_euler = (Vector(towards) - Vector(location)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.view_layer.update()


def render(engine, folder, size=SIZE, samples=64):
    """The channels of a render by "CYCLES" or "BOKEHGUIDE", `[H, W]`, top row first, by name without the layer (`Combined.R`)."""
    scene = bpy.context.scene
    scene.render.engine = engine
    scene.render.resolution_x, scene.render.resolution_y = size
    # Guided lens sampling needs fewer samples for the same noise.
    scene.cycles.samples, scene.bokehguide.samples = samples, min(samples, OUR_SAMPLES)
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.pixel_filter_type, scene.cycles.sample_clamp_indirect = "BOX", 0.0
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.bokehguide.max_bounces = 8
    path = Path(folder) / f"{engine}.exr"
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return read(path)


def read(path):
    """The channels of a multilayer EXR as of `render`."""
    parts = OpenEXR.File(str(path), separate_channels=True).parts  # Blender 5 writes a part for each pass
    channels = [item for part in parts for item in part.channels.items()]
    return {name.split(".", 1)[-1]: np.array(channel.pixels, np.float32) for name, channel in channels}


def both(folder, **options):
    """The colours `[H, W, 4]` by Cycles and by the add-on."""
    return tuple(colors(render(engine, folder, **options)) for engine in ("CYCLES", "BOKEHGUIDE"))


def colors(channels):
    """The channels of the combined pass, `[H, W, 4]`."""
    return np.stack([channels[f"Combined.{name}"] for name in "RGBA"], axis=-1)


def transparent():
    """Make the world black and transparent."""
    bpy.context.scene.render.film_transparent = True


def world(color=(0.0, 0.0, 0.0), strength=1.0):
    """A world of one colour; returns its node tree."""
    made = bpy.data.worlds.new("world")
    made.use_nodes = True
    bpy.context.scene.world = made
    node = made.node_tree.nodes["Background"]
    node.inputs["Color"].default_value, node.inputs["Strength"].default_value = (*color, 1.0), strength
    return made.node_tree


def disc(picture):
    """The diameter in pixels, and the centre (column, row), of the one bright disc of a picture `[H, W]`.

    A uniform disc of radius R has the mean squared distance R² / 2 from its centre, whatever its noise.
    """
    share = picture / picture.sum()
    rows, columns = np.indices(picture.shape)
    column, row = (columns * share).sum(), (rows * share).sum()
    squared = (((columns - column) ** 2 + (rows - row) ** 2) * share).sum()
    return 2.0 * math.sqrt(2.0 * squared), (column, row)


def blurred(picture, side=4):
    """Means over blocks of a picture `[H, W]`, as shares of its sum."""
    height, width = (length // side for length in picture.shape)
    means = picture[: height * side, : width * side].reshape(height, side, width, side).mean((1, 3))
    return means / means.sum()
