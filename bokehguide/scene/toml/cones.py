"""Cones of spotlights in a scene file."""

from __future__ import annotations

from bokehguide.errors import BokehguideError
from bokehguide.scene.tables import CONE_ANGLE, Table
from bokehguide.scene.types import Cone, Vector


def read_cone(parent: Table, key: str, axis: Vector | None = None) -> Cone:
    """The cone under `key` of the table `parent`. axis: its axis, None to read it from the cone's table.

    Raises BokehguideError naming file, field, value and remedy for an invalid cone.
    """
    keys = ("inner", "outer", "smooth") if axis is not None else ("axis", "inner", "outer", "smooth")
    table = Table(parent.values[key], parent.file, f"{parent.path}.{key}", keys)
    axis = table.direction("axis") if axis is None else axis
    outer, inner = table.number("outer", 45.0, CONE_ANGLE), table.number("inner", 0.0, CONE_ANGLE)
    if inner >= outer:
        raise BokehguideError(f"{table.place('outer')}: {outer:g} is not above inner, {inner:g}; give a larger angle")
    return Cone(axis, inner, outer, table.flag("smooth"))
