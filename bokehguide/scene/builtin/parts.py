"""What the built-in scenes are made of: turned bodies, tubes, skies, and a builder."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from bokehguide.scene.shapes import joined, spheres, transform, transformed, unit_box
from bokehguide.scene.types import Camera, Environment, Material, Mesh

if TYPE_CHECKING:
    from trimesh import Trimesh

CREASE = np.radians(35.0)
"""Edges sharper than this stay edges; the rest is shaded smoothly."""


class Builder:
    """Collects the surfaces of a scene by material."""

    def __init__(self) -> None:
        self.materials: list[Material] = []
        self._meshes: list[Mesh] = []

    def material(self, name: str, color: Sequence[float] = (0.8, 0.8, 0.8), **terms) -> int:
        """The index of a new material; `terms` are those of `Material`."""
        self.materials.append(Material(name, base_color=tuple(color), **terms))
        return len(self.materials) - 1

    def lamp(self, name: str, radiance: Sequence[float]) -> int:
        """The index of a new material that only emits `radiance`."""
        return self.material(name, (0.0, 0.0, 0.0), specular=0.0, emission=tuple(radiance))

    def add(self, mesh: Mesh, material: int, **placement) -> None:
        """Put `mesh` at `placement` (translate, rotate, scale, as in a scene file)."""
        self._meshes.append(_painted(transformed(mesh, transform(**placement)), material))

    def box(self, material: int, centre: Sequence[float], size: Sequence[float], **turn) -> None:
        """A box of `size` [x, y, z] around `centre`, metres."""
        self.add(unit_box(), material, translate=centre, scale=size, **turn)

    def balls(self, material: int, centres, radii) -> None:
        """Spheres at `centres` `[N, 3]` of `radii` `[N]` or one radius, metres."""
        self._meshes.append(spheres(np.atleast_2d(centres), radii, material))

    def meshes(self) -> tuple[Mesh, ...]:
        """One mesh for each material and kind of shading."""
        ordered = sorted(self._meshes, key=_kind)
        return tuple(joined(list(group)) for _, group in groupby(ordered, key=_kind))


def _kind(mesh: Mesh) -> tuple[int, bool]:
    return mesh.material, mesh.normals is None


def _painted(mesh: Mesh, material: int) -> Mesh:
    return Mesh(mesh.vertices, mesh.triangles, material, mesh.normals)


def shaded(surface: Trimesh) -> Mesh:
    """A trimesh with normals that are smooth except across creases."""
    from trimesh.graph import smooth_shade

    smooth = smooth_shade(surface, angle=CREASE)
    return Mesh(
        vertices=np.asarray(smooth.vertices, dtype=np.float32),
        triangles=np.asarray(smooth.faces, dtype=np.int32),
        material=0,
        normals=np.asarray(smooth.vertex_normals, dtype=np.float32),
    )


def lathe(profile: Sequence[tuple[float, float]], sections: int = 64) -> Mesh:
    """A body turned about y from its (radius, height) `profile`, listed from the bottom up."""
    from trimesh.creation import revolve

    body = revolve(np.asarray(profile, dtype=float), sections=sections)
    body.apply_transform(transform(rotate=(-90.0, 0.0, 0.0)))
    return shaded(body)


def ring(radius: float, thickness: float, sections: int = 64) -> Mesh:
    """A torus about y; `thickness` is the radius of its tube."""
    from trimesh.creation import torus

    around_z = torus(radius, thickness, major_sections=sections, minor_sections=20)
    around_z.apply_transform(transform(rotate=(-90.0, 0.0, 0.0)))
    return shaded(around_z)


def rod(start: Sequence[float], end: Sequence[float], radius: float, sections: int = 24) -> Mesh:
    """A closed cylinder from `start` to `end`."""
    from trimesh.creation import cylinder

    segment = np.array([start, end], dtype=float)
    return shaded(cylinder(radius, segment=segment, sections=sections))


def cable(points: np.ndarray, radius: float, sections: int = 8) -> Mesh:
    """A thin wire through `points` `[N, 3]`."""
    return joined([rod(a, b, radius, sections) for a, b in zip(points[:-1], points[1:])])


def gear(radius: float, teeth: int, thickness: float) -> Mesh:
    """A toothed rim about z with five spokes and a hub, flat-shaded."""
    tooth = radius * np.array([0.90, 1.0, 1.0, 0.90])
    outer = np.tile(tooth, teeth)
    angles = 2.0 * np.pi * (np.arange(4 * teeth) + 0.5) / (4 * teeth)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # Four loops of points: outer front, outer back, inner back, inner front.
    loops = [
        np.column_stack([circle * np.reshape(r, (-1, 1)), np.full(len(circle), z)])
        for r, z in (
            (outer, 0.5 * thickness),
            (outer, -0.5 * thickness),
            (np.full(len(circle), 0.74 * radius), -0.5 * thickness),
            (np.full(len(circle), 0.74 * radius), 0.5 * thickness),
        )
    ]
    here = np.arange(len(circle))
    there = np.roll(here, -1)
    sides = []
    for first in range(4):
        a, b = first * len(circle), (first + 1) % 4 * len(circle)
        sides += [np.column_stack([a + here, b + here, b + there])]
        sides += [np.column_stack([a + here, b + there, a + there])]
    rim = Mesh(np.concatenate(loops).astype(np.float32), np.concatenate(sides).astype(np.int32), 0)
    spokes = [
        transformed(
            unit_box(),
            transform(rotate=(0.0, 0.0, 72.0 * number))
            @ transform((0.4 * radius, 0, 0), scale=(0.76 * radius, 0.11 * radius, 0.7 * thickness)),
        )
        for number in range(5)
    ]
    hub = rod((0.0, 0.0, -0.6 * thickness), (0.0, 0.0, 0.6 * thickness), 0.16 * radius)
    return joined([_bare(part) for part in (rim, *spokes, hub)])


def _bare(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.triangles, 0)


def hanging(start: Sequence[float], end: Sequence[float], sag: float, count: int) -> np.ndarray:
    """`count` points of a cable that hangs `sag` metres between its ends, `[count, 3]`."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    points = (1.0 - t) * np.asarray(start, dtype=float) + t * np.asarray(end, dtype=float)
    points[:, 1] -= 4.0 * sag * (t * (1.0 - t))[:, 0]
    return points


def lamp_radius(camera: Camera, centres: np.ndarray, share: np.ndarray | float) -> np.ndarray:
    """Radii `[N]` of lamps at `centres` `[N, 3]` that cover `share` of the lens of `camera`.

    As a pixel in the middle of their bokeh sees it: R = r √share |d - Z| / d.
    """
    forward = np.subtract(camera.target, camera.position)
    forward = forward / np.linalg.norm(forward)
    depth = (np.atleast_2d(centres) - camera.position) @ forward
    stretch = np.abs(camera.focus_distance - depth) / camera.focus_distance
    return camera.aperture_radius * np.sqrt(share) * stretch


def gradient(stops: Sequence[tuple[float, Sequence[float]]], height: int = 32) -> np.ndarray:
    """A sky `[height, 2 height, 3]` of (elevation in degrees, radiance) `stops`, rising."""
    elevation = 90.0 - 180.0 * (np.arange(height) + 0.5) / height
    angles, colors = zip(*stops)
    rows = np.stack([np.interp(elevation, angles, c) for c in np.transpose(colors)], axis=1)
    return np.repeat(rows[:, None], 2 * height, axis=1).astype(np.float32)


def sky(*stops: tuple[float, Sequence[float]]) -> Environment:
    """An environment of `gradient` stops."""
    return Environment(gradient(stops))
