"""The world of a scene, as an `[environment]` table."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from .light_groups import LightGroups
from .messages import RenderError
from .node_chains import source
from .radiance_hdr import write_hdr

MAP_ROTATION = -90.0
"""Degrees. The middle of a map lies at Blender's +X and at -z of scene files, which is Blender's +Y."""
LINEAR = ("Linear Rec.709", "Linear", "Non-Color", "Raw")
"""Colour spaces of images whose files hold linear Rec.709."""


def read_world(scene: bpy.types.Scene, folder: Path, groups: LightGroups, warnings: list[str]) -> dict[str, Any] | None:
    """The `[environment]` table, None for a black world. folder: for maps that are no .hdr or .exr file yet."""
    world = scene.world
    if world is None:
        return None
    if world.use_nodes and world.node_tree:
        table = _from_nodes(world.node_tree, folder, warnings)
    else:
        table = {"color": tuple(world.color)}
    if table is None or max(table.get("color", (1.0,))) <= 0.0 or table.get("intensity", 1.0) <= 0.0:
        return None
    return table | groups.entry(world) | ({"visible": False} if scene.render.film_transparent else {})


def _from_nodes(tree: bpy.types.NodeTree, folder: Path, warnings: list[str]) -> dict[str, Any] | None:
    """The table of a Background node whose colour is constant or an Environment Texture."""
    output = tree.get_output_node("CYCLES")
    node = source(output.inputs["Surface"]) if output else None
    if node is None:
        return None
    if node.type not in ("BACKGROUND", "EMISSION"):
        warnings.append(f"world: the node {node.name} is ignored, the world is black; connect a Background node to the output")
        return None
    strength = node.inputs["Strength"]
    if strength.is_linked:
        warnings.append("world: the linked strength becomes 1; give a constant")
    factor = 1.0 if strength.is_linked else max(strength.default_value, 0.0)
    color = node.inputs["Color"]
    texture = source(color)
    if texture is None:
        return {"color": tuple(max(channel, 0.0) * factor for channel in tuple(color.default_value)[:3])}
    if texture.type != "TEX_ENVIRONMENT":
        warnings.append(
            f"world: the node {texture.name} is ignored, the world is black; use an Environment Texture with an image"
        )
        return None
    return _map(texture, folder, warnings) | {"intensity": factor}


def _map(texture: bpy.types.Node, folder: Path, warnings: list[str]) -> dict[str, Any]:
    """The keys of an Environment Texture. Raises RenderError without an image."""
    if texture.image is None:
        raise RenderError("world: the Environment Texture has no image; open one")
    if texture.projection != "EQUIRECTANGULAR":
        warnings.append("world: the mirror ball becomes an equirectangular map")
    mapping, turn = source(texture.inputs["Vector"]), 0.0
    if mapping is not None and mapping.type == "MAPPING":
        turn = _turn(mapping, warnings)
    elif mapping is not None and mapping.type != "TEX_COORD":
        warnings.append(f"world: the node {mapping.name} is ignored; rotate the map by a Mapping node")
    return {"map": str(_file(texture.image, folder, warnings)), "rotation": MAP_ROTATION + turn}


def _turn(mapping: bpy.types.Node, warnings: list[str]) -> float:
    """Degrees anticlockwise by which a Mapping node turns the map about the vertical axis."""
    rotation = mapping.inputs["Rotation"]
    # A point mapping turns the directions of the lookup, and the map turns against them.
    sign = 1.0 if mapping.vector_type == "TEXTURE" else -1.0
    values = {key: tuple(mapping.inputs[key].default_value) for key in ("Location", "Scale") if key in mapping.inputs}
    moved = any(abs(value) > 1e-6 for value in values.get("Location", ())) and mapping.vector_type in ("POINT", "TEXTURE")
    stretched = any(abs(value - 1.0) > 1e-6 for value in values.get("Scale", ()))
    tilted = any(abs(value) > 1e-6 for value in tuple(rotation.default_value)[:2])
    if moved or stretched or tilted or any(socket.is_linked for socket in mapping.inputs if socket.name != "Vector"):
        warnings.append("world: of the Mapping node, only a constant rotation about Z is used")
    return sign * math.degrees(rotation.default_value[2])


def _file(image: bpy.types.Image, folder: Path, warnings: list[str]) -> Path:
    """A .hdr or .exr file with the pixels of an image. Raises RenderError where the image cannot be read."""
    path = Path(bpy.path.abspath(image.filepath, library=image.library))
    on_disk = image.source == "FILE" and not image.packed_file and not image.is_dirty
    space = image.colorspace_settings.name
    linear = space in LINEAR
    if on_disk and linear and path.suffix.lower() in (".hdr", ".exr") and path.is_file():
        return path
    width, height = image.size
    if not image.has_data and not (width and height):
        raise RenderError(f"world: the image {image.name} cannot be read; check its path ({image.filepath})")
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    colors = pixels.reshape(height, width, image.channels)[::-1, :, : min(image.channels, 3)]
    # Pixels of floats are linear Rec.709 from every colour space, and pixels of 8 bits are those of the file.
    if not image.is_float and not linear:
        if space != "sRGB":
            warnings.append(f"world: the image {image.name} of 8 bits is taken as sRGB, not as {space}")
        colors = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    target = folder / f"world-{hashlib.sha256(pixels).hexdigest()[:16]}.hdr"
    if not target.exists():
        write_hdr(target, np.broadcast_to(colors, (height, width, 3)))
    return target
