"""The nodes between an input of a shader and its image, of which the glTF exporter stores a few."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

CONSTANT = {"RGB", "VALUE"}
ENDS = CONSTANT | {"VERTEX_COLOR", "ATTRIBUTE", "GROUP_INPUT"}
"""Nodes without an image that end a chain."""
SEPARATION = {"SEPARATE_COLOR", "SEPRGB"}
DATA = ("Non-Color", "Raw", "Linear Rec.709", "Linear", "scene_linear")
"""Colour spaces whose files hold the numbers of a data image."""
COLOR_LOSS = "images of colours are taken as 8-bit sRGB; convert them"
DATA_LOSS = "images of data are taken as Non-Color"
PLACE_LOSS = "images have UV coordinates that repeat; other projections, coordinates and extensions are ignored"


def source(socket: bpy.types.NodeSocket) -> bpy.types.Node | None:
    """The node that is linked to an input, beyond reroutes."""
    link = _link(socket)
    return link.from_node if link else None


def has_constant(socket: bpy.types.NodeSocket) -> bool:
    """Whether an input is linked to a constant."""
    node = source(socket)
    return node is not None and node.type in CONSTANT


def lost_nodes(socket: bpy.types.NodeSocket) -> Iterator[tuple[str, str]]:
    """Losses of a chain: a text with the name of an image, or no text with the label of a node that is ignored."""
    color = socket.type == "RGBA"
    for link, known in _links(socket):
        node, output = link.from_node, link.from_socket.name
        if node.type == "TEX_IMAGE":
            yield from _image_losses(node, color and output == "Color", output)
        elif not known:
            yield "", node.bl_label


def images_of(socket: bpy.types.NodeSocket) -> list[bpy.types.Image | None]:
    """The images of a chain."""
    return [link.from_node.image for link, _ in _links(socket) if link.from_node.type == "TEX_IMAGE"]


def _links(socket: bpy.types.NodeSocket) -> Iterator[tuple[bpy.types.NodeLink, bool]]:
    """The links of a chain, and whether the exporter follows the node at their start. Images and other nodes end a chain."""
    waiting, seen = [(socket, socket.name.endswith("Normal"))], set()
    while waiting:
        current, normal = waiting.pop()
        link = _link(current)
        if link is None or link.from_node.name in seen or link.from_node.type in ENDS:
            continue
        node = link.from_node
        seen.add(node.name)
        following: list[tuple[bpy.types.NodeSocket, bool]] = []
        if node.type == "GROUP":
            outputs = [each for each in node.node_tree.nodes if each.type == "GROUP_OUTPUT"] if node.node_tree else []
            following = [(each.inputs[link.from_socket.name], normal) for each in outputs]
        elif normal and node.type == "NORMAL_MAP" and node.space == "TANGENT":
            following = [(node.inputs["Color"], False)]
        elif not normal and _is_stored(node):
            following = [(each, False) for each in node.inputs if each.is_linked]
        yield link, bool(following)
        waiting += following


def _link(socket: bpy.types.NodeSocket) -> bpy.types.NodeLink | None:
    """The link of an input, beyond reroutes."""
    link = socket.links[0] if socket.is_linked and socket.links else None
    while link is not None and link.from_node.type == "REROUTE":
        links = link.from_node.inputs[0].links
        link = links[0] if links else None
    return link


def _is_stored(node: bpy.types.Node) -> bool:
    """Whether the exporter stores a node between an image and an input: channels and factors."""
    if node.type in SEPARATION:
        return True
    if node.type == "MATH":
        return node.operation == "MULTIPLY" and not node.use_clamp
    multiplies = node.type in ("MIX", "MIX_RGB") and node.blend_type == "MULTIPLY"
    colors = getattr(node, "data_type", "RGBA") == "RGBA"
    return multiplies and colors and not node.inputs[0].is_linked and node.inputs[0].default_value == 1.0


def _image_losses(node: bpy.types.Node, color: bool, output: str) -> Iterator[tuple[str, str]]:
    """Losses of an image texture. color: whether its colours count; output: the name of the linked output."""
    image = node.image
    if image is None:
        yield "", f"{node.bl_label} without an image"
        return
    space = image.colorspace_settings.name
    if color and (space != "sRGB" or image.is_float):
        yield COLOR_LOSS, f"{image.name} ({space}{', float' if image.is_float else ''})"
    elif not color and output == "Color" and space not in DATA:
        yield DATA_LOSS, f"{image.name} ({space})"
    if node.projection != "FLAT" or node.extension != "REPEAT" or not _has_uvs(node.inputs["Vector"]):
        yield PLACE_LOSS, image.name


def _has_uvs(socket: bpy.types.NodeSocket) -> bool:
    """Whether the coordinates of an image are UVs, perhaps with a mapping."""
    link = _link(socket)
    if link is None or link.from_node.type == "UVMAP":
        return True
    if link.from_node.type == "MAPPING":
        return link.from_node.vector_type == "POINT" and _has_uvs(link.from_node.inputs["Vector"])
    return link.from_node.type == "TEX_COORD" and link.from_socket.name == "UV"
