"""Shader nodes that become glTF materials without the exporter, which knows the Principled BSDF and Emission nodes only."""

from __future__ import annotations

from typing import Any

import bpy

SPECULAR, IOR, TRANSMISSION = "KHR_materials_specular", "KHR_materials_ior", "KHR_materials_transmission"
USED = {"BSDF_DIFFUSE": ("Color",), "BSDF_GLOSSY": ("Color", "Roughness"), "BSDF_GLASS": ("Color", "Roughness", "IOR")}
"""Inputs by the types of the nodes that become glTF materials."""
IGNORED = {"BSDF_DIFFUSE": ("Roughness", "Normal"), "BSDF_GLOSSY": ("Anisotropy", "Normal"), "BSDF_GLASS": ("Normal",)}
"""Inputs of these nodes that have no effect."""


def is_simple(node: bpy.types.Node) -> bool:
    """Whether a shader node has constants for all inputs that its glTF material stores."""
    return node.type in USED and not any(node.inputs[name].is_linked for name in USED[node.type])


def ignored_inputs(node: bpy.types.Node) -> list[str]:
    """The inputs of a simple shader node that have no effect."""
    known = [node.inputs[name] for name in IGNORED[node.type] if name in node.inputs]
    return [each.name for each in known if each.is_linked or (each.type == "VALUE" and each.default_value > 0.0)]


def gltf_material(node: bpy.types.Node) -> dict[str, Any]:
    """The keys of the glTF material of a simple shader node."""
    color = [min(max(channel, 0.0), 1.0) for channel in tuple(node.inputs["Color"].default_value)[:3]]
    base: dict[str, Any] = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    if node.type == "BSDF_DIFFUSE":
        return {"pbrMetallicRoughness": base, "extensions": {SPECULAR: {"specularFactor": 0.0}}}
    base["roughnessFactor"] = min(max(node.inputs["Roughness"].default_value, 0.0), 1.0)
    if node.type == "BSDF_GLOSSY":
        return {"pbrMetallicRoughness": base | {"metallicFactor": 1.0}}
    ior = max(node.inputs["IOR"].default_value, 1.0)
    return {"pbrMetallicRoughness": base, "extensions": {IOR: {"ior": ior}, TRANSMISSION: {"transmissionFactor": 1.0}}}
