"""The materials of a scene in its glTF file, and the warnings of lost nodes and inputs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from .images import SLOTS, converted_images, srgb_png
from .messages import Losses
from .node_chains import COLOR_LOSS, has_constant, lost_nodes, source
from .shaders import gltf_material, ignored_inputs, is_simple

TEXTURED = {
    "Base Color",
    "Metallic",
    "Roughness",
    "Alpha",
    "Normal",
    "Transmission Weight",
    "Coat Weight",
    "Coat Roughness",
    "Coat Normal",
    "Specular IOR Level",
    "Specular Tint",
    "Emission Color",
}
"""Inputs of the Principled BSDF node that may have an image."""
IGNORED = ("Subsurface Weight", "Anisotropic", "Thin Film Thickness", "Diffuse Roughness")
"""Inputs of the Principled BSDF node that the exporter leaves out."""
SINGLE_SCATTERING = {"bokehguide_single_scattering": True}
"""Extras of materials without multiple scattering between microfacets."""
NODE_LOSS = "nodes of materials are ignored; bake them to images"
INPUT_LOSS = "inputs of shader nodes are ignored"


def material_warnings(depsgraph: bpy.types.Depsgraph) -> list[str]:
    """Warnings with the names of the materials that are not exported whole."""
    losses = Losses()
    for material, output, node in _surfaces(depsgraph):
        if output is not None:
            for name in ("Volume", "Displacement"):
                if output.inputs[name].is_linked:
                    losses.add("inputs of Material Output nodes are ignored", f"{material} ({name})")
        _check_surface(material, node, losses)
    return losses.lines()


def simple_materials(depsgraph: bpy.types.Depsgraph) -> dict[str, dict[str, Any]]:
    """The keys of glTF materials that replace those of the exporter, or join them, by name."""
    found = {}
    for material, _, node in _surfaces(depsgraph):
        if node is not None and is_simple(node):
            found[material] = gltf_material(node)
        if node is not None and getattr(node, "distribution", "") == "GGX":
            found[material] = found.get(material, {}) | {"extras": SINGLE_SCATTERING}
    return found


def converted_textures(depsgraph: bpy.types.Depsgraph) -> dict[str, dict[str, bytes]]:
    """PNG files that replace textures of the exporter, by material and glTF texture."""
    found = {}
    for material, _, node in _surfaces(depsgraph):
        if node is not None and node.type == "BSDF_PRINCIPLED":
            found[material] = {slot: srgb_png(image) for slot, image in converted_images(node).items() if min(image.size) > 0}
    return found


def _surfaces(depsgraph: bpy.types.Depsgraph) -> Iterator[tuple[str, bpy.types.Node | None, bpy.types.Node | None]]:
    """The name of each material of the rendered objects, its output node, and the shader node there; None without one."""
    slots = (slot for instance in depsgraph.object_instances for slot in instance.object.material_slots)
    materials = {slot.material.name: slot.material for slot in slots if slot.material is not None}
    for name, each in materials.items():
        if each.use_nodes and each.node_tree is not None:
            output = each.node_tree.get_output_node("CYCLES")
            yield name, output, source(output.inputs["Surface"]) if output else None


def _check_surface(material: str, node: bpy.types.Node | None, losses: Losses) -> None:
    """Add the losses of the shader node at the output of a material."""
    if node is not None and node.type == "EMISSION":
        _check_input(material, node.inputs["Color"], True, losses)
        _check_input(material, node.inputs["Strength"], False, losses)
    elif node is not None and is_simple(node):
        for name in ignored_inputs(node):
            losses.add(INPUT_LOSS, f"{material} ({name})")
    elif node is None or node.type != "BSDF_PRINCIPLED":
        losses.add("materials without a Principled BSDF at their output lose their look", material)
    else:
        converted = [name for name, slot in SLOTS.items() if slot in converted_images(node)]
        for socket in node.inputs:
            if socket.name in IGNORED and _reaches(socket, 0.0):
                losses.add(INPUT_LOSS, f"{material} ({socket.name})")
            elif socket.name not in IGNORED and socket.name != "Tangent":
                left_out = COLOR_LOSS if socket.name in converted else ""
                _check_input(material, socket, socket.name in TEXTURED, losses, left_out)


def _reaches(socket: bpy.types.NodeSocket, value: float) -> bool:
    """Whether an input may be greater than a value."""
    return socket.is_linked or socket.default_value > value


def _check_input(material: str, socket: bpy.types.NodeSocket, textured: bool, losses: Losses, left_out: str = "") -> None:
    """Add the losses of an input. textured: whether the exporter stores its image; left_out: text of a loss that is none."""
    if not socket.is_linked or has_constant(socket):
        return
    if not textured:
        losses.add(INPUT_LOSS, f"{material} ({socket.name})")
        return
    for text, name in lost_nodes(socket):
        if not text or text != left_out:
            losses.add(text or NODE_LOSS, name if text else f"{material} ({name})")
