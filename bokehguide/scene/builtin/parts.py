"""Building blocks of the built-in scenes: solids of revolution, tubes, gears and a builder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np
from numpy.typing import ArrayLike

from bokehguide.scene.builtin.solids import along, merged, revolved, shaded
from bokehguide.scene.shapes import joined, spheres, transform, transformed, unit_box
from bokehguide.scene.types import Camera, Material, Mesh, as_vector


class Builder:
    """Collector of the meshes and materials of a scene."""

    def __init__(self) -> None:
        self.materials: list[Material] = []
        self._meshes: list[Mesh] = []

    def material(self, name: str, color: Sequence[float] = (0.8, 0.8, 0.8), **terms) -> int:
        """The index of a new material. terms: fields of `Material`."""
        self.materials.append(Material(name, base_color=as_vector(color), **terms))
        return len(self.materials) - 1

    def emitter(self, name: str, radiance: Sequence[float]) -> int:
        """The index of a new black material that emits `radiance`."""
        return self.material(name, (0.0, 0.0, 0.0), specular=0.0, emission=as_vector(radiance))

    def add(self, mesh: Mesh, material: int, **placement) -> None:
        """Add `mesh` with a transform. placement: translate, rotate and scale, as in a scene file."""
        self._meshes.append(_painted(transformed(mesh, transform(**placement)), material))

    def box(self, material: int, centre: ArrayLike, size: ArrayLike, **rotation) -> None:
        """Add a box of `size` [x, y, z] around `centre`, metres. rotation: `rotate` of `transform`."""
        self.add(unit_box(), material, translate=centre, scale=size, **rotation)

    def spheres(self, material: int, centres: ArrayLike, radii: ArrayLike) -> None:
        """Add spheres at `centres` `[N, 3]` of `radii` `[N]` or one radius, metres."""
        self._meshes.append(spheres(np.atleast_2d(centres), radii, material))

    def meshes(self) -> tuple[Mesh, ...]:
        """One mesh for each combination of material and shading, named after its material."""
        ordered = sorted(self._meshes, key=_kind)
        groups = [list(group) for _, group in groupby(ordered, key=_kind)]
        return tuple(replace(joined(group), name=self.materials[group[0].material].name) for group in groups)


def _kind(mesh: Mesh) -> tuple[int, bool]:
    """The material, and whether the shading is flat."""
    return mesh.material, mesh.normals is None


def _painted(mesh: Mesh, material: int) -> Mesh:
    """`mesh` with another material and without uvs."""
    return Mesh(mesh.vertices, mesh.triangles, material, mesh.normals)


def lathe(profile: Sequence[tuple[float, float]], sections: int = 64) -> Mesh:
    """A solid of revolution about y. profile: (radius, height) pairs from the bottom up."""
    return shaded(merged(revolved(profile, sections)).moved(transform(rotate=(-90.0, 0.0, 0.0))))


def ring(radius: float, thickness: float, sections: int = 64) -> Mesh:
    """A torus about y. thickness: radius of the tube."""
    angles = np.linspace(0.0, 2.0 * np.pi, 21)
    tube = np.column_stack((thickness * np.cos(angles), thickness * np.sin(angles))) + [radius, 0.0]
    return shaded(merged(revolved(tube, sections)).moved(transform(rotate=(-90.0, 0.0, 0.0))))


def rod(start: ArrayLike, end: ArrayLike, radius: float, sections: int = 24) -> Mesh:
    """A closed cylinder from `start` to `end`."""
    placement, height = along(start, end)
    profile = [(0.0, -height / 2), (radius, -height / 2), (radius, height / 2), (0.0, height / 2)]
    return shaded(merged(revolved(profile, sections).moved(placement)))


def cable(points: np.ndarray, radius: float, sections: int = 8) -> Mesh:
    """A chain of rods through `points` `[N, 3]`."""
    return joined([rod(a, b, radius, sections) for a, b in pairwise(points)])


def gear(radius: float, teeth: int, thickness: float) -> Mesh:
    """A flat-shaded gear about z: a toothed rim, five spokes and a hub."""
    tooth = radius * np.array([0.90, 1.0, 1.0, 0.90])
    outer = np.tile(tooth, teeth)
    angles = 2.0 * np.pi * (np.arange(4 * teeth) + 0.5) / (4 * teeth)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # Four loops of vertices: outer front, outer back, inner back, inner front.
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
    return joined([Mesh(part.vertices, part.triangles, 0) for part in (rim, *spokes, hub)])


def hanging(start: Sequence[float], end: Sequence[float], sag: float, count: int) -> np.ndarray:
    """Points `[count, 3]` of a cable that sags by `sag` metres between its ends."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    points = (1.0 - t) * np.asarray(start, dtype=float) + t * np.asarray(end, dtype=float)
    points[:, 1] -= 4.0 * sag * (t * (1.0 - t))[:, 0]
    return points


def emitter_radius(camera: Camera, centres: np.ndarray, coverage: np.ndarray | float) -> np.ndarray:
    """Radii `[N]` of emitters at `centres` `[N, 3]` that cover the fraction `coverage` of the lens.

    The emitter at depth Z is seen from the centre of its bokeh, with focus distance d and lens
    radius r: R = r √coverage |d - Z| / d.
    """
    forward = np.subtract(camera.target, camera.position)
    forward = forward / np.linalg.norm(forward)
    depth = (np.atleast_2d(centres) - camera.position) @ forward
    stretch = np.abs(camera.focus_distance - depth) / camera.focus_distance
    return camera.aperture_radius * np.sqrt(coverage) * stretch
