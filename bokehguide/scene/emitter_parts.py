"""Emissive triangles in compact parts, and the shapes of the parts.

A proposal on the lens is the outline of an emitter. Draws from the outline of a ring would mostly miss the light. Draws from the
outline of a long tube would mostly miss the lens. Such components are divided into compact parts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bokehguide.scene.components import connected_components
from bokehguide.scene.types import Mesh

MOST_EMPTY = 4.0
"""Largest ratio of outline area to visible area of a part that is not divided. A straight tube has 2, a cube 1.6, a ball 1."""
MOST_ELONGATED = 16.0
"""Largest ratio of the longest axis to the next of a part that is not divided."""
FEWEST_TRIANGLES = 16
"""Parts of fewer triangles are not divided."""
MOST_PARTS = 2048
"""Emitters of a scene at which no part is divided any more."""


class Parts(NamedTuple):
    """Shapes of K parts of a mesh: fields of `Emitters`.

    centres: `[K, 3]`. radii, bounding_radii: `[K]`. ellipsoids: `[K, 3, 3]`. half_edges: `[K, 2, 3]`.
    """

    centres: np.ndarray
    radii: np.ndarray
    bounding_radii: np.ndarray
    ellipsoids: np.ndarray
    half_edges: np.ndarray


def compact_parts(mesh: Mesh, most: int, groups: np.ndarray | int = 0) -> tuple[np.ndarray, Parts]:
    """The part of each triangle, int32 `[T]`, and the shapes of the parts.

    Parts are connected components, of which long and empty ones are divided. The plane through the centre of a part, across its
    longest axis, divides the part. Triangles of a part connect at equal vertex positions. most: number of parts beyond which none
    is divided. groups: of triangles, `[T]`; groups do not connect.
    """
    points, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners = index.reshape(-1)[mesh.triangles].astype(np.int64)
    middles = mesh.vertices[mesh.triangles].mean(axis=1, dtype=np.float64)
    labels = _components(corners, np.broadcast_to(groups, len(corners)).astype(np.int64), len(points))
    while True:
        parts = shapes(mesh, labels)
        squares, axes = np.linalg.eigh(parts.ellipsoids)
        divided = (squares[:, 2] > MOST_ELONGATED**2 * squares[:, 1]) | (emptiness(parts.ellipsoids, parts.radii) > MOST_EMPTY)
        divided &= np.bincount(labels) >= FEWEST_TRIANGLES
        divided &= np.cumsum(divided) <= most - len(parts.radii)
        if not divided.any():
            return labels, parts
        beyond = ((middles - parts.centres[labels]) * axes[labels, :, 2]).sum(1) > 0.0
        found = _components(corners, 2 * labels.astype(np.int64) + (divided[labels] & beyond), len(points))
        if found.max() == labels.max():  # triangles at one place
            return labels, parts
        labels = found


def emptiness(ellipsoids: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Area of the widest cross section of ellipsoids `[N, 3, 3]` over the areas of discs of radii `[N]`, float64 `[N]`."""
    axes = np.linalg.eigvalsh(ellipsoids)[:, 1:]
    return np.sqrt(axes.prod(1)) / np.maximum(radii * radii, 1e-300)


def _components(corners: np.ndarray, labels: np.ndarray, points: int) -> np.ndarray:
    """The connected component of each triangle among those of its label, int32 `[T]`.

    corners: point of each corner, below `points`, `[T, 3]`. labels: `[T]`.
    """
    nodes, corners = np.unique(corners + labels[:, None] * points, return_inverse=True)
    corners = corners.reshape(-1, 3)
    return connected_components(corners[:, [0, 1, 0, 2]].reshape(-1, 2), len(nodes))[corners[:, 0]]


def shapes(mesh: Mesh, labels: np.ndarray) -> Parts:
    """The shapes of the parts of `mesh`. labels: of its triangles, `[T]`.

    The mean projected area of a closed convex surface is a quarter of its area (Cauchy). An open part counts with the length of
    its vector area, if this is larger.
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    vectors = 0.5 * np.cross(b - a, c - a)
    areas = np.linalg.norm(vectors, axis=1)
    total = np.bincount(labels, areas)
    middles = (a + b + c) / 3.0 * areas[:, None]
    centres = np.stack([np.bincount(labels, column) for column in middles.T], axis=1)
    facing = np.linalg.norm([np.bincount(labels, column) for column in vectors.T], axis=0)
    projected = np.maximum(facing, total / 4.0)
    centres /= total[:, None]
    corners = np.stack((a, b, c)) - centres[labels]
    bounding = np.zeros(len(total))
    for corner in corners:
        np.maximum.at(bounding, labels, np.linalg.norm(corner, axis=1))
    ellipsoids = _ellipsoids(corners, areas, labels)
    half_edges = _half_edges(np.moveaxis(corners, 0, 1), labels)
    return Parts(centres, np.sqrt(projected / np.pi), bounding, ellipsoids, half_edges)


def _half_edges(corners: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Half edges `[K, 2, 3]` of the parts that are parallelograms of two triangles, 0 for others.

    corners: of triangles, relative to the centres of their parts, `[T, 3, 3]`. labels: `[T]`.
    """
    counts = np.bincount(labels)
    edges = np.zeros((len(counts), 2, 3))
    order = np.argsort(labels, kind="stable")
    pairs = order[np.repeat(counts == 2, counts)].reshape(-1, 2)
    one, other = corners[pairs[:, 0]], corners[pairs[:, 1]]
    shared = (one[:, :, None] == other[:, None]).all(3)  # exact positions, as for the components
    adjacent = shared.any(2).sum(1) == 2
    opposite = np.argmin(shared.any(2), axis=1)
    components, one, opposite = labels[pairs[:, 0]][adjacent], one[adjacent], opposite[adjacent]
    across = np.argmin(shared[adjacent].any(1), axis=1)
    rows = np.arange(len(one))
    first, last = one[rows, opposite], other[adjacent][rows, across]
    left, right = one[rows, (opposite + 1) % 3], one[rows, (opposite + 2) % 3]
    closes = np.linalg.norm(first + last - left - right, axis=1) < 1e-4 * np.linalg.norm(right - left, axis=1)
    edges[components[closes]] = 0.5 * np.stack((left - first, right - first), axis=1)[closes]
    return edges


def _ellipsoids(corners: np.ndarray, areas: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The smallest ellipsoids `[K, 3, 3]` with the covariances of parts that contain their corners.

    corners: of triangles, relative to the centres of their parts, `[3, T, 3]`. areas, labels: `[T]`.
    """
    whole = corners.sum(0)
    products = (np.einsum("cti,ctj->tij", corners, corners) + whole[:, :, None] * whole[:, None]) * areas[:, None, None] / 12.0
    total = np.bincount(labels, areas)
    spread = np.stack([np.bincount(labels, column) for column in products.reshape(-1, 9).T], axis=1) / total[:, None]
    spread = spread.reshape(-1, 3, 3)
    widest = np.trace(spread, axis1=1, axis2=2)
    spread += (1e-6 * widest + 1e-30)[:, None, None] * np.eye(3)  # flat parts stay invertible
    inverse = np.linalg.inv(spread)[labels]
    reach = np.zeros(len(total))
    for corner in corners:
        np.maximum.at(reach, labels, np.einsum("ti,tij,tj->t", corner, inverse, corner))
    return spread * reach[:, None, None]
