"""What the glTF exporter loses of the materials of a scene."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from .messages import listed

TEXTURED = (
    "Base Color",
    "Metallic",
    "Roughness",
    "Alpha",
    "Normal",
    "Transmission Weight",
    "Coat Weight",
    "Coat Roughness",
    "Specular IOR Level",
    "Emission Color",
)
"""Inputs of the Principled BSDF node that may have an image."""
STORED = {"TEX_IMAGE", "VERTEX_COLOR", "ATTRIBUTE", "RGB", "VALUE"}
"""Sources of an input that the exporter stores."""


def material_warnings(depsgraph: bpy.types.Depsgraph) -> list[str]:
    """Warnings with the names of the materials that are not exported whole."""
    shaders, textures = [], []
    for material in _materials(depsgraph):
        if not material.use_nodes or material.node_tree is None:
            continue
        node = _surface(material.node_tree)
        if node is None or node.type != "BSDF_PRINCIPLED":
            shaders.append(material.name)
        elif any(_is_lost(node.inputs[name]) for name in TEXTURED if name in node.inputs):
            textures.append(material.name)
    warnings = []
    if shaders:
        warnings.append(f"materials without a Principled BSDF at their output lose their look: {listed(shaders)}")
    if textures:
        warnings.append(f"procedural textures are lost; bake them to images: {listed(textures)}")
    return warnings


def _materials(depsgraph: bpy.types.Depsgraph) -> list[bpy.types.Material]:
    """The materials of the rendered objects, each once."""
    slots = (slot for instance in depsgraph.object_instances for slot in instance.object.material_slots)
    return list({slot.material.name: slot.material for slot in slots if slot.material is not None}.values())


def _surface(tree: bpy.types.NodeTree) -> bpy.types.Node | None:
    """The shader node at the output, beyond reroutes."""
    output = tree.get_output_node("CYCLES")
    return next(_sources(output.inputs["Surface"]), None) if output else None


def _is_lost(socket: bpy.types.NodeSocket) -> bool:
    """Whether an input has a source that the exporter does not store."""
    if not socket.is_linked:
        return False
    waiting, seen = list(_sources(socket)), set()
    while waiting:
        node = waiting.pop()
        if node.type in STORED:
            return False
        if node.name not in seen:
            seen.add(node.name)
            waiting += [source for each in node.inputs for source in _sources(each)]
    return True


def _sources(socket: bpy.types.NodeSocket) -> Iterator[bpy.types.Node]:
    """The nodes that are linked to an input, beyond reroutes."""
    for link in socket.links:
        if link.from_node.type == "REROUTE":
            yield from _sources(link.from_node.inputs[0])
        else:
            yield link.from_node
