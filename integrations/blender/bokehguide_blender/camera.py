"""The camera of a scene, as a `[camera]` table and a framing."""

from __future__ import annotations

import math
from typing import Any

import bpy

from .axes import Matrix, Vector, column, dot, forward, unit, y_up
from .framing import Framing, aperture_radius, frame
from .messages import RenderError

RATIOS = (0.1, 10.0)
"""Aspect ratios that bokehguide's apertures may have."""


def read_framing(
    camera: bpy.types.Camera, render: bpy.types.RenderSettings, size: tuple[int, int], warnings: list[str]
) -> Framing:
    """The framing of a camera for a picture of `size` pixels. Raises RenderError for cameras without perspective."""
    if camera.type != "PERSP":
        raise RenderError(f"{camera.name}: bokehguide renders perspective cameras only; set the lens type to Perspective")
    if render.pixel_aspect_x != render.pixel_aspect_y:
        warnings.append("the pixel aspect is ignored; pixels are square")
    border = (render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y) if render.use_border else None
    sensor, shift = (camera.sensor_width, camera.sensor_height), (camera.shift_x, camera.shift_y)
    return frame(camera.lens, sensor, camera.sensor_fit, size, shift, border)


def read_camera(camera: bpy.types.Object, framing: Framing, warnings: list[str]) -> dict[str, Any]:
    """The `[camera]` table, and `[camera.aperture]`, of an evaluated camera."""
    return camera_table(camera.matrix_world, framing.fov) | read_lens(camera, warnings)


def camera_table(matrix: Matrix, fov: float, back: float = 0.0) -> dict[str, Any]:
    """The `[camera]` table of a pinhole. matrix: rows, from the camera to the world. back: metres that the pinhole steps back."""
    ahead = forward(matrix)
    position = [a - back * b for a, b in zip(column(matrix, 3), ahead)]
    return {
        "position": y_up(position),
        "target": y_up([a + b for a, b in zip(position, ahead)]),
        "up": y_up(unit(column(matrix, 1))),
        "fov": fov,
        "aperture_radius": 0.0,
        "focus_distance": 1.0,
    }


def read_lens(camera: bpy.types.Object, warnings: list[str]) -> dict[str, Any]:
    """The keys of a `[camera]` table for the depth of field of an evaluated camera; empty where it is off."""
    matrix, lens = camera.matrix_world, camera.data
    if not lens.dof.use_dof:
        return {}
    return {
        "aperture_radius": aperture_radius(lens.lens, lens.dof.aperture_fstop),
        "focus_distance": focus_distance(lens.dof, column(matrix, 3), forward(matrix)),
        "aperture": _aperture(lens.dof, warnings),
    }


def in_frame(table: dict[str, Any], framing: Framing, position: Vector) -> bool:
    """Whether a position of Blender lies in the frame of a `[camera]` table, or within a tenth of its width around it."""
    ahead = [a - b for a, b in zip(table["target"], table["position"])]
    offset = [a - b for a, b in zip(y_up(position), table["position"])]
    depth, up = dot(offset, ahead), dot(offset, table["up"])
    across = max(dot(offset, offset) - depth**2 - up**2, 0.0) ** 0.5
    half = 0.6 * depth * 2.0 * math.tan(0.5 * math.radians(framing.fov))
    return depth > 0.0 and across < half and abs(up) < half * framing.size[1] / framing.size[0]


def focus_distance(dof: bpy.types.CameraDOFSettings, position: Vector, ahead: Vector) -> float:
    """Metres along the optical axis `ahead`, of the focus object or of its bone where there is one."""
    target = dof.focus_object
    if target is None:
        return max(dof.focus_distance, 1e-6)
    matrix = target.matrix_world
    if target.type == "ARMATURE" and dof.focus_subtarget in target.pose.bones:
        matrix = matrix @ target.pose.bones[dof.focus_subtarget].matrix
    offset = [a - b for a, b in zip(column(matrix, 3), position)]
    return max(abs(dot(offset, ahead)), 1e-6)


def _aperture(dof: bpy.types.CameraDOFSettings, warnings: list[str]) -> dict[str, Any]:
    """The shape of the opening. As in Cycles, fewer than three blades are a round opening."""
    ratio = min(max(dof.aperture_ratio, RATIOS[0]), RATIOS[1])
    if abs(ratio - dof.aperture_ratio) > 1e-6:
        warnings.append(f"the aperture ratio {dof.aperture_ratio:g} becomes {ratio:g}")
    table: dict[str, Any] = {"ratio": ratio}
    if dof.aperture_blades >= 3:
        table |= {"blades": min(dof.aperture_blades, 64), "rotation": math.degrees(dof.aperture_rotation)}
    return table
