"""The lights of a scene, as `[[light]]` and `[[sun]]` tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import bpy

from . import light_tables
from .axes import Matrix, Vector, column, length
from .light_groups import LightGroups
from .messages import Losses

ROUNDING = 1e-3
"""Relative difference of lengths, and difference of angles in degrees, that counts as none."""


def read_lights(
    depsgraph: bpy.types.Depsgraph, in_frame: Callable[[Vector], bool], groups: LightGroups, warnings: list[str]
) -> dict[str, list[dict[str, Any]]]:
    """The tables of all lights, instances included, by the names `light` and `sun`. in_frame: whether the camera sees a point."""
    lights, suns, losses = [], [], Losses()
    for instance in depsgraph.object_instances:
        if instance.object.type != "LIGHT":
            continue
        light, matrix, name = instance.object.data, [tuple(row) for row in instance.matrix_world], instance.object.name
        color = _color(light, name, losses)
        if not _shines(light, color, name, losses):
            continue
        if light.type == "SUN":
            suns.append(_sun(light, matrix, name, color, losses) | groups.entry(instance.object))
            continue
        lights.append(_light(light, matrix, name, color, losses) | groups.entry(instance.object))
        if not instance.object.visible_camera and in_frame(column(matrix, 3)):
            losses.add("the camera sees lights that Blender hides from the camera", name)
    warnings += losses.lines()
    return {name: tables for name, tables in (("light", lights), ("sun", suns)) if tables}


def _shines(light: bpy.types.Light, color: Vector, name: str, losses: Losses) -> bool:
    """Whether a light has a power above zero in some channel and below zero in none."""
    power = [channel * light.energy for channel in color]
    if min(power) < 0.0:
        losses.add("lights of negative power or colour are left out", name)
    return min(power) >= 0.0 and max(power) > 0.0


def _sun(light: bpy.types.Light, matrix: Matrix, name: str, color: Vector, losses: Losses) -> dict[str, Any]:
    """The table of a sun."""
    least, most = light_tables.SUN_ANGLES
    # The angle is in single precision.
    if not least - ROUNDING <= math.degrees(light.angle) <= most + ROUNDING:
        losses.add(f"the angles of suns are limited to {least:g}° … {most:g}°", name)
    return light_tables.sun(matrix, color, light.energy, light.angle)


def _light(light: bpy.types.Light, matrix: Matrix, name: str, color: Vector, losses: Losses) -> dict[str, Any]:
    """The table of a light with a size."""
    watts, normalized = light.energy, getattr(light, "normalize", True)  # Blender 4.2 has normalised lights only
    if light.type == "AREA":
        if light.spread < 3.14:
            losses.add("the spread of area lights is ignored; these lights shine in all directions of their front", name)
        return light_tables.area(name, matrix, color, watts, light.shape, (light.size, light.size_y), normalized)
    if light.type == "SPOT":
        if light.use_square:
            losses.add("the square cones of spotlights become round", name)
        if _uneven(matrix):
            losses.add("the uneven scale of spotlights is ignored", name)
        size, blend = light.spot_size, light.spot_blend
        return light_tables.spot(name, matrix, color, watts, light.shadow_soft_size, size, blend, normalized)
    return light_tables.point(name, matrix, color, watts, light.shadow_soft_size, normalized)


def _color(light: bpy.types.Light, name: str, losses: Losses) -> Vector:
    """The colour of a light with its temperature, exposure and Emission node, linear Rec.709."""
    color = tuple(light.color)
    if getattr(light, "use_temperature", False):
        color = tuple(a * b for a, b in zip(color, light.temperature_color))
    factor = 2.0 ** getattr(light, "exposure", 0.0)
    if light.use_nodes and light.node_tree:
        node = _emission_node(light.node_tree)
        if node is None or any(node.inputs[key].is_linked for key in ("Color", "Strength")):
            losses.add("the nodes of lights are ignored; give an Emission node with constant values", name)
        else:
            factor *= node.inputs["Strength"].default_value
            color = tuple(a * b for a, b in zip(color, node.inputs["Color"].default_value))
    return color[0] * factor, color[1] * factor, color[2] * factor


def _emission_node(tree: bpy.types.NodeTree) -> bpy.types.Node | None:
    """The Emission node at the output of a light, None where another node is there."""
    output = tree.get_output_node("CYCLES")
    links = output.inputs["Surface"].links if output else ()
    node = links[0].from_node if links else None
    return node if node is not None and node.type == "EMISSION" else None


def _uneven(matrix: Matrix) -> bool:
    """Whether a matrix scales its axes by different factors."""
    sizes = [length(column(matrix, index)) for index in range(3)]
    return max(sizes) - min(sizes) > ROUNDING * max(sizes)
