"""The `[[light]]` and `[[sun]]` tables of Blender's lights. Needs no Blender.

Power of Cycles' lights: the flux of a point light of P watts is P, and of an area light of P watts as well. A sun's strength is
its irradiance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from .axes import Matrix, Vector, column, forward, length, scaled, unit, y_up

LUMINANCE = (0.2126, 0.7152, 0.0722)
SMALLEST_RADIUS = 0.001
"""Metres; bokehguide's lights have a size."""
SUN_ANGLES = (0.01, 90.0)
"""Degrees that bokehguide's suns may have."""
Table = dict[str, Any]


def luminance(color: Sequence[float]) -> float:
    return sum(weight * channel for weight, channel in zip(LUMINANCE, color))


def point(name: str, matrix: Matrix, color: Vector, watts: float, radius: float, normalized: bool = True) -> Table:
    """A point light. color: linear Rec.709. normalized: whether the flux is independent of the radius."""
    radius = max(radius, SMALLEST_RADIUS)
    watts *= 1.0 if normalized else 4.0 * math.pi * radius**2
    table = {"name": name, "shape": "sphere", "radius": radius, "position": y_up(column(matrix, 3))}
    return table | _power(color, watts)


def spot(
    name: str, matrix: Matrix, color: Vector, watts: float, radius: float, size: float, blend: float, normalized: bool
) -> Table:
    """A spotlight. size: angle of the whole cone in radians; blend: of its edge, 0 to 1."""
    outer = min(0.5 * size, 0.5 * math.pi)
    inner = math.acos(min(math.cos(outer) + (1.0 - math.cos(outer)) * blend, 1.0))
    cone = {"inner": math.degrees(min(inner, 0.999 * outer)), "outer": math.degrees(outer), "smooth": True}
    table = point(name, matrix, color, watts, radius, normalized)
    return table | {"direction": y_up(forward(matrix)), "cone": cone}


def area(
    name: str, matrix: Matrix, color: Vector, watts: float, shape: str, size: tuple[float, float], normalized: bool
) -> Table:
    """An area light. shape: "SQUARE", "RECTANGLE", "DISK" or "ELLIPSE"; size: before the scale of the matrix."""
    right, up = column(matrix, 0), column(matrix, 1)
    sides = size[0] * length(right), (size[1] if shape in ("RECTANGLE", "ELLIPSE") else size[0]) * length(up)
    round_shape = shape in ("DISK", "ELLIPSE")
    watts *= 1.0 if normalized else sides[0] * sides[1] * (0.25 * math.pi if round_shape else 1.0)
    table = {
        "name": name,
        "shape": "ellipse" if round_shape else "rectangle",
        "size": sides,
        "position": y_up(column(matrix, 3)),
        "direction": y_up(forward(matrix)),
        "up": y_up(unit(up)),
    }
    return table | _power(color, watts)


def sun(matrix: Matrix, color: Vector, strength: float, angle: float) -> Table:
    """A sun. strength: irradiance; angle: diameter in radians."""
    degrees = min(max(math.degrees(angle), SUN_ANGLES[0]), SUN_ANGLES[1])
    return {"direction": y_up(unit(column(matrix, 2))), "irradiance": scaled(color, strength), "angle": degrees}


def _power(color: Vector, watts: float) -> Table:
    """Flux and colour. `watts` of scene files count the luminance of the colour."""
    return {"watts": watts * luminance(color), "color": color}
