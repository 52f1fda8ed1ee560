"""Quadrics of pbrt as meshes: surfaces of revolution about z.

u runs with the angle φ from x to y. v is 0 at the lower end of a sphere and a cylinder, and at the rim of a disc.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.types import Mesh

SEGMENTS = 64
"""Segments of a full turn; in scenes of many quadrics a half or a quarter."""


def sphere(parameters: Parameters, segments: int = SEGMENTS) -> Mesh:
    """A sphere about the origin, or its part between zmin and zmax, up to phimax."""
    radius = _radius(parameters)
    low = min(max(parameters.number("zmin", -radius), -radius), radius)
    high = min(max(parameters.number("zmax", radius), -radius), radius)
    if low > high:
        low, high = high, low
    unit = _unit_sphere(low / radius, high / radius, _turn(parameters), segments)
    return replace(unit, vertices=unit.vertices * np.float32(radius))


@lru_cache(maxsize=64)
def _unit_sphere(low: float, high: float, turn: float, segments: int) -> Mesh:
    """The part of a sphere of radius 1 from the height `low` to `high`, up to the angle `turn`, radians."""
    start, end = math.acos(low), math.acos(high)
    rings = max(1, math.ceil(0.5 * segments * (start - end) / math.pi))
    theta = np.linspace(start, end, rings + 1)
    profile = np.stack([np.sin(theta), np.cos(theta)], axis=1)
    return _with_area(_revolved(profile, profile, turn, segments), turn * (high - low), profile)


def cylinder(parameters: Parameters, segments: int = SEGMENTS) -> Mesh:
    """A cylinder about z without caps."""
    radius = _radius(parameters)
    low, high = parameters.number("zmin", -1.0), parameters.number("zmax", 1.0)
    profile = np.array([(radius, min(low, high)), (radius, max(low, high))])
    return _revolved(profile, np.array([(1.0, 0.0)] * 2), _turn(parameters), segments)


def disk(parameters: Parameters, segments: int = SEGMENTS) -> Mesh:
    """A disc, or a ring, at `height`, facing +z."""
    radius, height = _radius(parameters), parameters.number("height", 0.0)
    inner = min(max(parameters.number("innerradius", 0.0), 0.0), radius)
    profile, turn = np.array([(radius, height), (inner, height)]), _turn(parameters)
    mesh = _revolved(profile, np.array([(0.0, 1.0)] * 2), turn, segments)
    angle = turn / _steps(turn, segments)
    flat = np.array((1.0, 1.0, 0.0)) * math.sqrt(angle / math.sin(angle)) + np.array((0.0, 0.0, 1.0))
    return Mesh((mesh.vertices * flat).astype(np.float32), mesh.triangles, 0, None, mesh.uvs)


def cone(parameters: Parameters, segments: int = SEGMENTS) -> Mesh:
    """A cone of pbrt-v3 from its `radius` at z = 0 to the tip at `height`."""
    radius, height = _radius(parameters), parameters.number("height", 1.0)
    return _drawn(np.array([(radius, 0.0), (0.0, height)]), parameters, segments)


def paraboloid(parameters: Parameters, segments: int = SEGMENTS) -> Mesh:
    """A paraboloid of pbrt-v3, which has its `radius` at zmax and its tip at the origin, from zmin to zmax."""
    radius, top = _radius(parameters), parameters.number("zmax", 1.0)
    if not top > 0.0:
        parameters.fail("zmax", "is out of range; give a number above 0")
    z = np.linspace(min(max(parameters.number("zmin", 0.0), 0.0), top), top, segments // 4 + 1)
    return _drawn(np.stack([radius * np.sqrt(z / top), z], axis=1), parameters, segments)


def hyperboloid(parameters: Parameters, segments: int = SEGMENTS) -> Mesh:
    """A hyperboloid of pbrt-v3: the line from p1 to p2, turned about z."""
    ends = np.array([parameters.vector(key, default) for key, default in (("p1", (0.0, 0.0, 0.0)), ("p2", (1.0, 1.0, 1.0)))])
    share = np.linspace(0.0, 1.0, segments // 4 + 1)[:, None]
    line = (1.0 - share) * ends[0] + share * ends[1]
    return _drawn(np.stack([np.hypot(line[:, 0], line[:, 1]), line[:, 2]], axis=1), parameters, segments)


def _drawn(profile: np.ndarray, parameters: Parameters, segments: int) -> Mesh:
    """The surface of revolution of `profile` `[R, 2]`, with the normals of its slope to the right of its direction."""
    slope = np.gradient(profile, axis=0)
    normals = np.stack([slope[:, 1], -slope[:, 0]], axis=1)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-12)
    return _revolved(profile, normals, _turn(parameters), segments)


def _radius(parameters: Parameters) -> float:
    radius = parameters.number("radius", 1.0)
    if not radius > 0.0:
        parameters.fail("radius", "is out of range; give a number above 0")
    return radius


def _turn(parameters: Parameters) -> float:
    """The angle phimax in radians."""
    return math.radians(min(max(parameters.number("phimax", 360.0), 0.01), 360.0))


def _steps(turn: float, segments: int) -> int:
    """Segments up to the angle `turn`, radians, of `segments` of a full turn."""
    return max(3, math.ceil(segments * turn / (2.0 * math.pi)))


def _revolved(profile: np.ndarray, normals: np.ndarray, turn: float, segments: int) -> Mesh:
    """The surface of revolution of `profile` `[R, 2]`, (distance from the axis, z), with `normals` `[R, 2]` in the same plane.

    turn: the angle that it covers, radians.
    """
    steps, rows = _steps(turn, segments), len(profile)
    phi = np.linspace(0.0, turn, steps + 1)
    circle = np.stack([np.cos(phi), np.sin(phi), np.ones_like(phi)], axis=1)
    points, directions = (each[:, None, [0, 0, 1]] * circle for each in (profile, normals))
    u, v = np.meshgrid(np.linspace(0.0, 1.0, steps + 1), np.linspace(1.0, 0.0, rows))
    corner = (np.arange(rows - 1)[:, None] * (steps + 1) + np.arange(steps)).reshape(-1)
    up = corner + steps + 1
    triangles = np.concatenate([np.stack([corner, corner + 1, up + 1], 1), np.stack([corner, up + 1, up], 1)])
    uvs = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float32)
    flat = directions.reshape(-1, 3).astype(np.float32)
    return Mesh(points.reshape(-1, 3).astype(np.float32), triangles.astype(np.int32), 0, flat, uvs)


def _with_area(mesh: Mesh, area: float, profile: np.ndarray) -> Mesh:
    """`mesh`, scaled about the origin to `area` if it is a whole sphere; a part keeps its ends."""
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    found = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    whole = abs(profile[0, 1] + 1.0) < 1e-6 and abs(profile[-1, 1] - 1.0) < 1e-6
    scale = math.sqrt(area / found) if whole and found > 0.0 else 1.0
    return Mesh((mesh.vertices * scale).astype(np.float32), mesh.triangles, 0, mesh.normals, mesh.uvs)
