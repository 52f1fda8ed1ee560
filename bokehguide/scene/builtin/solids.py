"""Solids of revolution with smooth shading, in NumPy alone.

The solids are those of trimesh 5 to the bit, so that built-in scenes do not depend on the release of trimesh, and do not wait for
its import. `shaded` is trimesh's `smooth_shade`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bokehguide.scene.components import connected_components
from bokehguide.scene.types import Mesh

CREASE = np.radians(35.0)
"""Radians; edges with a larger angle between their faces stay sharp."""
FLAT_PARTS = 10.0
"""Whole area over the least area from which a flat part, such as the end of a cylinder, has normals of its own."""
FLATNESS = 5000.0
"""Squared radius of curvature over squared width, above which two adjacent faces are one flat part."""
STRAIGHT = np.radians(0.01)
"""Radians; faces with a smaller angle have an infinite radius of curvature."""
MERGED = 1e-8
"""Metres between vertices that are one vertex; also the least area of a face, and the least angle of its corners."""
ZERO = 1e-13
"""Largest length of a vector that has no direction."""


class Solid(NamedTuple):
    """A surface whose faces share vertices. vertices: float64 `[V, 3]`, metres; faces: int64 `[T, 3]`."""

    vertices: np.ndarray
    faces: np.ndarray

    def moved(self, matrix: np.ndarray) -> Solid:
        """The solid under an affine `matrix` `[4, 4]` that reflects nothing."""
        points = np.column_stack((self.vertices, np.ones(len(self.vertices))))
        return Solid(np.ascontiguousarray((matrix @ points.T).T[:, :3]), self.faces)


def revolved(profile: ArrayLike, sections: int) -> Solid:
    """The surface of a profile that turns about z. profile: radius and height, metres, `[P, 2]`. Vertices are not merged."""
    profile = np.asarray(profile, dtype=np.float64)
    per, angles = len(profile), np.linspace(0.0, 2.0 * np.pi, sections + 1)
    circle = np.column_stack((np.cos(angles), np.sin(angles)))
    across = np.tile(circle, (1, per)).reshape(-1, 2) * np.tile(profile[:, 0], len(circle))[:, None]
    vertices = np.column_stack((across, np.tile(profile[:, 1], len(circle))))[:-per]
    slice_ = (np.array([[0, per, 1], [1, per, per + 1]]) + np.arange(per - 1)[:, None, None]).reshape(-1, 3)
    slice_ = slice_[0.5 * np.sqrt((_crosses(vertices[slice_]) ** 2).sum(axis=1)) > MERGED]
    faces = slice_ + np.arange(sections)[:, None, None] * per
    return Solid(vertices, faces.reshape(-1, 3) % len(vertices))


def merged(solid: Solid) -> Solid:
    """The solid with one vertex at each place, in the order of first appearance, and without vertices that no face has."""
    used = np.zeros(len(solid.vertices), dtype=bool)
    used[solid.faces] = True
    places = (solid.vertices[used] * 10**8).round().astype(np.int64)
    _, first, inverse = np.unique(places, axis=0, return_index=True, return_inverse=True)
    order = first.argsort()
    number = np.zeros(len(used), dtype=np.int64)
    number[used] = order.argsort()[inverse.ravel()]
    return Solid(solid.vertices[np.flatnonzero(used)[first[order]]], number[solid.faces])


def along(start: ArrayLike, end: ArrayLike) -> tuple[np.ndarray, float]:
    """The rotation and translation `[4, 4]` that puts a cylinder about z between two points, and their distance in metres."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis, middle = end - start, np.eye(4)
    turns = [np.linalg.svd(vector.reshape(-1, 1))[0] for vector in (np.array([0.0, 0.0, 1.0]), axis)]
    for turn in turns:
        if np.linalg.det(turn) < 0.0:
            turn[:, -1] *= -1.0
    rotation = np.eye(4)
    rotation[:3, :3] = turns[1].dot(turns[0].T)
    middle[:3, 3] = start + axis * 0.5
    return np.dot(middle, rotation), float(np.linalg.norm(axis))


def shaded(solid: Solid) -> Mesh:
    """The solid with normals that are smooth except at creases: patches of faces have vertices of their own."""
    normals, patches = _face_normals(solid), _patches(solid)
    order = np.concatenate(patches)
    number = np.repeat(np.arange(len(patches)), [len(patch) for patch in patches])
    corners, places = np.unique(number[:, None] * len(solid.vertices) + solid.faces[order], return_inverse=True)
    smooth = Solid(solid.vertices[corners % len(solid.vertices)], places.reshape(-1, 3))
    vertex_normals = _vertex_normals(smooth, normals[order])
    return Mesh(
        vertices=smooth.vertices.astype(np.float32),
        triangles=smooth.faces.astype(np.int32),
        material=0,
        normals=vertex_normals.astype(np.float32),
    )


def _patches(solid: Solid) -> list[np.ndarray]:
    """The faces of each smooth patch, then those of each large flat part, then single faces."""
    pairs, edges = _adjacent(solid.faces)
    normals, count = _face_normals(solid), len(solid.faces)
    angles = np.abs(np.arccos(np.clip(_dots(normals[pairs[:, 0]], normals[pairs[:, 1]]), -1.0, 1.0)))
    areas = np.sqrt((_crosses(solid.vertices[solid.faces]) ** 2).sum(axis=1)) / 2.0
    parts = _components(pairs[_coplanar(solid, pairs, edges, angles)], np.arange(count))
    least = areas.sum() / FLAT_PARTS
    flat = [part for part in parts if areas[part].sum() > least]
    curved = np.ones(count, dtype=bool)
    for part in flat:
        curved[part] = False
    smooth = pairs[angles < CREASE]
    smooth = smooth[curved[smooth].all(axis=1)]
    patches = _components(smooth, np.unique(smooth)) + flat
    if not patches:
        return [np.arange(count)]
    return patches + list(np.setdiff1d(np.arange(count), np.concatenate(patches)).reshape(-1, 1))


def _adjacent(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of faces that share an edge, `[E, 2]`, and the vertices of the edges, ascending, `[E, 2]`."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, number, counts = np.unique(edges[:, 0] * (faces.max() + 1) + edges[:, 1], return_inverse=True, return_counts=True)
    twice = np.flatnonzero(counts[number] == 2)
    twice = twice[number[twice].argsort(kind="stable")].reshape(-1, 2)
    pairs = np.sort(twice // 3, axis=1)
    proper = pairs[:, 0] != pairs[:, 1]
    return pairs[proper], edges[twice[proper, 0]]


def _coplanar(solid: Solid, pairs: np.ndarray, edges: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Whether adjacent faces lie almost in a plane, bool `[E]`."""
    corners = solid.faces[pairs]
    opposite = corners[(corners[..., None] != edges[:, None, None]).all(-1)].reshape(-1, 2)
    across = solid.vertices[opposite[:, 1]] - solid.vertices[opposite[:, 0]]
    edge = _unit(solid.vertices[edges[:, 1]] - solid.vertices[edges[:, 0]])
    widths = np.sqrt(np.dot((across - _dots(across, edge)[:, None] * edge) ** 2, [1] * 3))
    radii, bent, wide = np.full(len(pairs), np.inf), angles > STRAIGHT, widths > ZERO
    radii[bent] = widths[bent] / np.abs(2.0 * np.sin(angles[bent]))
    found = np.ones(len(pairs), dtype=bool)
    found[wide] = (radii[wide] / widths[wide]) ** 2 > FLATNESS
    return found


def _components(pairs: np.ndarray, nodes: np.ndarray) -> list[np.ndarray]:
    """Connected components of two faces or more, in the order of their first faces.

    pairs: connected faces, `[E, 2]`; nodes: all faces to sort, ascending. The sort is not stable, as in trimesh: the order of the
    faces of a component depends on all nodes.
    """
    if len(pairs) == 0:
        return []
    labels = connected_components(pairs, nodes[-1] + 1)[nodes]
    order = labels.argsort()
    ends = np.flatnonzero(np.diff(labels[order])) + 1
    return [nodes[part] for part in np.split(order, ends) if len(part) > 1]


def _vertex_normals(solid: Solid, normals: np.ndarray) -> np.ndarray:
    """Means of the faces' normals, weighted by the angles of the corners, `[V, 3]`."""
    corners = solid.vertices[solid.faces]
    u, v, w = (_unit(corners[:, end] - corners[:, start]) for start, end in ((0, 1), (0, 2), (1, 2)))
    first, second = (np.arccos(np.clip(_dots(a, b), -1.0, 1.0)) for a, b in ((u, v), (-u, w)))
    angles = np.stack((first, second, np.pi - first - second), axis=1)
    angles[(angles < MERGED).any(axis=1)] = 0.0
    kept = (normals**2).sum(axis=1) > 0.5
    total = np.zeros_like(solid.vertices)
    np.add.at(total, solid.faces[kept].ravel(), angles[kept].reshape(-1, 1) * np.repeat(normals[kept], 3, axis=0))
    return _unit(total)


def _face_normals(solid: Solid) -> np.ndarray:
    """Unit normals `[T, 3]`, 0 for a face without area."""
    crosses = _crosses(solid.vertices[solid.faces])
    return np.where((crosses**2).sum(axis=1, keepdims=True) > ZERO**2, _unit(crosses), 0.0)


def _crosses(corners: np.ndarray) -> np.ndarray:
    """Normals `[T, 3]` of triangles `[T, 3, 3]`, twice as long as their area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.dot(a * b, [1.0] * 3)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors `[N, 3]`; vectors without a direction stay."""
    lengths = np.sqrt(_dots(vectors, vectors))
    lengths[lengths > ZERO] **= -1
    return vectors * lengths[:, None]
