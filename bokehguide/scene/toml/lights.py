"""The `[[light]]` and `[[sun]]` tables of a scene file: suns, and emissive spheres, discs, ellipses and rectangles.

Emissive shapes stand alone or in strings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bokehguide.color import LUMENS_PER_WATT, LUMINANCE, blackbody
from bokehguide.scene.checks import check_light_group, located
from bokehguide.scene.model import LightSizes
from bokehguide.scene.shapes import (
    SPHERE_SUBDIVISIONS,
    repeated,
    surface_area,
    transformed,
    unit_disc,
    unit_rectangle,
    unit_sphere,
)
from bokehguide.scene.strings import String
from bokehguide.scene.tables import EMITTER_RADIUS, KELVIN, NOT_NEGATIVE, POSITIVE, SUN_ANGLE, Table, did_you_mean, is_number
from bokehguide.scene.toml.cones import read_cone
from bokehguide.scene.types import Material, Mesh, Sun, Vector, as_vector

LIGHT_SHAPES = {"sphere": unit_sphere, "disc": unit_disc, "ellipse": unit_disc, "rectangle": unit_rectangle}
MAX_LIGHTS = 10_000
"""Lights of a file, which bounds its memory."""
COARSE_LIGHTS = 64
"""Spheres of a table beyond which each has 320 triangles in place of 1,280."""
NEEDS = {
    "radius": ("sphere", "disc"),
    "size": ("ellipse", "rectangle"),
    "direction": ("disc", "ellipse", "rectangle", "sphere with a cone"),
    "up": ("ellipse", "rectangle"),
    "cone": ("sphere",),
}
"""Keys that have an effect on the listed shapes only."""
PLACES = ("position", "positions", "path")
INTENSITIES = ("radiance", "watts", "lumens", "candela")
LIGHT_KEYS = ("name", "group", "shape", *NEEDS, *PLACES, "spacing", "sag", *INTENSITIES, "color", "kelvin")
DOWN = (0.0, -1.0, 0.0)


def read_light_tables(root: Table, first: int) -> tuple[list[Mesh], list[Material]]:
    """The meshes of the `[[light]]` tables, and a material for each. first: the index of the first of these materials.

    Raises BokehguideError naming file, field, value and remedy for invalid tables.
    """
    values = root.values.get("light", [])
    if not isinstance(values, list):
        root.fail("light", "is not a list of tables; write [[light]]")
    meshes, materials, lights = [], [], 0
    for number, entry in enumerate(values):
        table = Table(entry, root.file, f"light[{number}]", LIGHT_KEYS)
        name = table.text("name") or table.path
        centres = _centres(table, MAX_LIGHTS - lights)
        lights += len(centres)
        shape = _shape(table, len(centres))
        with located(f"{root.file}: {table.path}"):
            mesh = repeated(shape, centres, first + len(meshes), name)
        emission = _emission(table, surface_area(mesh) / len(centres))
        meshes.append(mesh)
        cone = read_cone(table, "cone", _direction(table)) if "cone" in table else None
        light = {"emission": emission, "emission_cone": cone, "light_group": check_light_group(table, "group")}
        materials.append(Material(name, base_color=(0.0, 0.0, 0.0), specular=0.0, **light))
    return meshes, materials


def read_sun_tables(root: Table) -> list[Sun]:
    """The `[[sun]]` tables. Raises BokehguideError naming file, field, value and remedy for invalid tables."""
    values = root.values.get("sun", [])
    if not isinstance(values, list):
        root.fail("sun", "is not a list of tables; write [[sun]]")
    suns = []
    for number, entry in enumerate(values):
        table = Table(entry, root.file, f"sun[{number}]", ("direction", "irradiance", "angle", "group"))
        if "irradiance" not in table:
            table.missing("irradiance", "give [r, g, b] on a surface that faces the sun")
        irradiance = table.vector("irradiance", None, NOT_NEGATIVE)
        angle = table.number("angle", LightSizes.sun_angle, SUN_ANGLE)
        suns.append(Sun(table.direction("direction"), angle, irradiance, check_light_group(table, "group")))
    return suns


def _shape(table: Table, count: int) -> Mesh:
    """The shape of each of `count` lights around the origin."""
    kind = table.text("shape") or "sphere"
    if kind not in LIGHT_SHAPES:
        table.fail("shape", f"is not the shape of a light; {did_you_mean(kind, LIGHT_SHAPES)}")
    named = f"{kind} with a cone" if kind == "sphere" and "cone" in table else kind
    for key, kinds in NEEDS.items():
        if key in table and not {kind, named} & set(kinds):
            table.fail(key, f"has no effect on a {kind}; it is for a light of shape {' or '.join(kinds)}; leave it out")
    matrix = np.eye(4)
    if kind in NEEDS["size"]:
        width, height = _size(table)
        matrix[:3, :3] = _axes(table) * (0.5 * width, 0.5 * height, 1.0)
    else:
        radius = table.number("radius", None, EMITTER_RADIUS)
        matrix[:3, :3] = (np.eye(3) if kind == "sphere" else _axes(table)) * radius
    coarse = kind == "sphere" and count > COARSE_LIGHTS
    return transformed(unit_sphere(SPHERE_SUBDIVISIONS - 1) if coarse else LIGHT_SHAPES[kind](), matrix)


def _size(table: Table) -> tuple[float, float]:
    """Width and height of a rectangle or an ellipse in metres."""
    if "size" not in table:
        table.missing("size", "give [width, height] in metres")
    size = table.values["size"]
    if not (isinstance(size, list) and len(size) == 2 and all(is_number(side) and POSITIVE.contains(side) for side in size)):
        table.fail("size", f"is not a width and a height; give two numbers, each {POSITIVE.remedy}")
    return float(size[0]), float(size[1])


def _axes(table: Table) -> np.ndarray:
    """The directions of the width, of the height and of the light, as the columns of `[3, 3]`."""
    forward = np.array(_direction(table))
    upright = abs(forward[1]) > 1.0 - 1e-6
    up = np.array(table.direction("up") if "up" in table else (0.0, 0.0, -1.0) if upright else (0.0, 1.0, 0.0))
    right = np.cross(up, forward)
    length = np.linalg.norm(right)
    if length < 1e-4:
        table.fail("up", "is parallel to the direction of the light; give another")
    right /= length
    return np.stack((right, np.cross(forward, right), forward), axis=1)


def _direction(table: Table) -> Vector:
    """The unit vector along which a light shines."""
    return table.direction("direction") if "direction" in table else DOWN


def _centres(table: Table, most: int) -> np.ndarray:
    """The centres of the lights of a table, `[N, 3]`, at most so many."""
    table.exclusive(*PLACES)
    for key in ("spacing", "sag"):
        if key in table and "path" not in table:
            table.fail(key, "has no path beside it; give the supports of the string, or leave it out")
    if "path" not in table:
        if "position" not in table and "positions" not in table:
            table.missing("position", "give [x, y, z], or positions, or a path with a spacing")
        several = "positions" in table
        centres = _points(table, "positions", 1) if several else np.array([table.vector("position", None)])
        _check_count(table, "positions" if several else "position", len(centres), most)
        return centres
    supports, sag = _points(table, "path", 2), table.number("sag", 0.0, NOT_NEGATIVE)
    spacing = table.number("spacing", None, POSITIVE)
    try:
        string = String(supports, sag)
    except ValueError as error:
        table.fail("path", f"is no string: {error}; move the supports apart")
    _check_count(table, "spacing", string.count(spacing), most)
    return string.points(spacing)


def _check_count(table: Table, key: str, count: float, most: int) -> None:
    """Fail if `key` makes more lights than the file may still have."""
    if count > most:
        table.fail(key, f"makes {count:,.0f} more lights; give fewer; a file has at most {MAX_LIGHTS:,}")


def _points(table: Table, key: str, least: int) -> np.ndarray:
    """The points of a list, `[N, 3]`, at least `least` of them."""
    values = table.values[key]
    if not (isinstance(values, list) and len(values) >= least):
        table.fail(key, f"is no list of points; give {least} or more as [[x, y, z], …]")
    names = [f"{key}[{index}]" for index in range(len(values))]
    points = Table(dict(zip(names, values)), table.file, table.path, names)
    return np.array([points.vector(name, None) for name in names])


def _emission(table: Table, area: float) -> Vector:
    """The radiance of one light whose surface has `area` square metres."""
    table.exclusive(*INTENSITIES)
    table.exclusive("color", "kelvin")
    given = [key for key in INTENSITIES if key in table]
    if not given:
        table.missing("watts", f"give one of {', '.join(INTENSITIES)}")
    if area <= 0.0:
        table.fail(next(key for key in PLACES if key in table), "is too far from the origin for a light of this size; enlarge it")
    key = given[0]
    if key == "radiance" and not is_number(table.values[key]):
        for other in ("color", "kelvin"):
            if other in table:
                table.fail(other, "has no effect beside a radiance of three numbers; keep one")
        return table.vector(key, None, NOT_NEGATIVE)
    # A sphere is seen as a quarter of its surface, a disc or a rectangle from the front as all of it.
    seen = area / 4.0 if (table.text("shape") or "sphere") == "sphere" else area
    areas = {"radiance": 1.0, "watts": math.pi * area, "lumens": LUMENS_PER_WATT * math.pi * area}
    luminance = table.number(key, None, NOT_NEGATIVE) / areas.get(key, LUMENS_PER_WATT * seen)
    radiance = as_vector(luminance * channel for channel in _color(table))
    if not all(map(NOT_NEGATIVE.contains, radiance)):
        table.fail(key, f"makes a radiance of {max(radiance):g}; give less; the maximum is {NOT_NEGATIVE.high:g}")
    return radiance


def _color(table: Table) -> Sequence[float]:
    """The colour of a light with a luminance of 1, so that it changes no power."""
    if "kelvin" in table:
        return blackbody(table.number("kelvin", None, KELVIN)).tolist()
    color = np.array(table.vector("color", (1.0, 1.0, 1.0), NOT_NEGATIVE))
    luminance = float(LUMINANCE @ color)
    if luminance <= 0.0:
        table.fail("color", "is black; give a colour, or leave the light out")
    return (color / luminance).tolist()
