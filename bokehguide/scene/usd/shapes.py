"""Spheres, cubes, cylinders, cones, capsules and planes as meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bokehguide.scene.shapes import (
    SIDES,
    joined,
    strip,
    transform,
    transformed,
    tube,
    unit_box,
    unit_disc,
    unit_rectangle,
    unit_sphere,
)
from bokehguide.scene.tables import NOT_NEGATIVE
from bokehguide.scene.types import Mesh
from bokehguide.scene.usd.stage import Stage

RINGS = 16
"""Rings of a hemisphere of a capsule."""
Reader = Callable[[Stage, Any], Mesh]


def read_shape(opened: Stage, prim: Any) -> Mesh | None:
    """The shape of a prim in its own space, with the material index 0; None for a kind without triangles."""
    read = READERS.get(str(prim.GetTypeName()))
    return None if read is None else read(opened, prim)


def number(opened: Stage, prim: Any, name: str) -> float:
    """A size of a prim. Raises BokehguideError, naming the prim, if it is negative or not finite."""
    value = float(prim.GetAttribute(name).Get(opened.time))
    if not NOT_NEGATIVE.contains(value):
        opened.fail(prim, f"{name}: {value:g} is out of range; give {NOT_NEGATIVE.remedy}")
    return value


def along(mesh: Mesh, axis: str) -> Mesh:
    """A shape around z, turned around the axis "X", "Y" or "Z"."""
    turns = {"X": [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]], "Y": [[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0]]}
    return transformed(mesh, np.array([*turns[axis], [0, 0, 0, 1]], np.float64)) if axis in turns else mesh


def _cap(radius: float, z: float, up: bool) -> Mesh:
    """A disc across z that faces +z or -z."""
    disc = transformed(unit_disc(), transform(scale=max(radius, 1e-30)))
    disc = disc if up else transformed(disc, transform(rotate=(180.0, 0.0, 0.0)))
    moved = transformed(disc, transform((0.0, 0.0, z)))
    return replace(moved, normals=np.tile((0.0, 0.0, 1.0 if up else -1.0), (len(moved.vertices), 1)))


def _sphere(opened: Stage, prim: Any) -> Mesh:
    return transformed(unit_sphere(), transform(scale=number(opened, prim, "radius")))


def _cube(opened: Stage, prim: Any) -> Mesh:
    return transformed(unit_box(), transform(scale=number(opened, prim, "size")))


def _cylinder(opened: Stage, prim: Any) -> Mesh:
    radius, height = number(opened, prim, "radius"), number(opened, prim, "height")
    parts = [tube(radius, height, radius), _cap(radius, height / 2.0, True), _cap(radius, -height / 2.0, False)]
    return along(joined(parts), prim.GetAttribute("axis").Get(opened.time))


def _cone(opened: Stage, prim: Any) -> Mesh:
    radius, height = number(opened, prim, "radius"), number(opened, prim, "height")
    return along(
        joined([tube(radius, height, 0.0), _cap(radius, -height / 2.0, False)]), prim.GetAttribute("axis").Get(opened.time)
    )


def _capsule(opened: Stage, prim: Any) -> Mesh:
    radius, height = number(opened, prim, "radius"), number(opened, prim, "height")
    bend = np.linspace(0.0, np.pi / 2.0, RINGS + 1)
    tilt = np.concatenate([bend - np.pi / 2.0, bend])
    middle = np.repeat((-height / 2.0, height / 2.0), RINGS + 1)
    turn = 2.0 * np.pi * np.arange(SIDES + 1) / SIDES
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(SIDES + 1)], axis=1)
    normals = np.cos(tilt)[:, None, None] * around + np.sin(tilt)[:, None, None] * (0, 0, 1)
    points = radius * normals + middle[:, None, None] * (0, 0, 1)
    u, v = np.meshgrid(np.arange(SIDES + 1) / SIDES, 1.0 - np.arange(len(tilt)) / (len(tilt) - 1))
    uvs = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    mesh = Mesh(points.reshape(-1, 3), strip(len(tilt), SIDES + 1), 0, normals.reshape(-1, 3), uvs)
    return along(mesh, prim.GetAttribute("axis").Get(opened.time))


def _plane(opened: Stage, prim: Any) -> Mesh:
    """A rectangle: the width is along x and the length along y where the axis is z; along z and y for x, along x and z for y."""
    width, length = number(opened, prim, "width") / 2.0, number(opened, prim, "length") / 2.0
    axis = prim.GetAttribute("axis").Get(opened.time)
    scale = (length, width, 1.0) if axis == "X" else (width, length, 1.0)
    if axis == "Y":
        return transformed(transformed(unit_rectangle(), transform(scale=scale)), transform(rotate=(-90.0, 0.0, 0.0)))
    return along(transformed(unit_rectangle(), transform(scale=scale)), axis)


READERS: dict[str, Reader] = {
    "Sphere": _sphere,
    "Cube": _cube,
    "Cylinder": _cylinder,
    "Cone": _cone,
    "Capsule": _capsule,
    "Plane": _plane,
}
"""Readers of shapes by the type of the prim."""
