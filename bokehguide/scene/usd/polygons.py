"""Polygons as triangles."""

from __future__ import annotations

import numpy as np

MAX_CLIPPED = 500
"""Corners of a concave polygon that ears are cut from; the time grows with the square."""


def triangulate(points: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangles of polygons: positions `[T, 3]` in `indices`, and the polygon `[T]` of each triangle.

    points: `[P, 3]`. counts: corners of each polygon, `[F]`. indices: into `points`, `[sum of counts]`, all in range. Convex
    polygons become fans around their first corner; concave ones lose ears one by one. Polygons with fewer than three corners
    have no triangles.
    """
    starts = np.cumsum(counts) - counts
    parts, faces = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for corners in np.unique(counts[counts >= 3]):
        chosen = np.flatnonzero(counts == corners)
        polygons = starts[chosen][:, None] + np.arange(corners)
        steps = np.arange(1, corners - 1)
        fans = np.stack([np.zeros_like(steps), steps, steps + 1], axis=1)
        triangles = polygons[:, fans]
        if corners > 3:
            for concave in np.flatnonzero(_concave(points[indices[polygons]])):
                if corners <= MAX_CLIPPED:
                    triangles[concave] = polygons[concave][_ears(points[indices[polygons[concave]]])]
        parts.append(triangles.reshape(-1, 3))
        faces.append(np.repeat(chosen, corners - 2))
    triangles, owners = np.concatenate(parts), np.concatenate(faces)
    order = np.argsort(owners, kind="stable")
    return triangles[order], owners[order]


def _normals(polygons: np.ndarray) -> np.ndarray:
    """Normals `[F, 3]` of polygons `[F, N, 3]` by Newell's method, of no unit length."""
    return np.cross(polygons, np.roll(polygons, -1, axis=1)).sum(axis=1)


def _concave(polygons: np.ndarray) -> np.ndarray:
    """Whether each of the polygons `[F, N, 3]` has a corner that turns against its normal."""
    polygons = polygons.astype(np.float64)
    polygons = polygons - polygons[:, :1]
    edges = np.roll(polygons, -1, axis=1) - polygons
    turns = np.cross(np.roll(edges, 1, axis=1), edges)
    along = np.einsum("fni,fi->fn", turns, _normals(polygons))
    return (along < -1e-6 * np.abs(along).max(axis=1, keepdims=True)).any(axis=1)


def _ears(polygon: np.ndarray) -> np.ndarray:
    """The triangles `[N - 2, 3]` of one polygon `[N, 3]`, cut off one by one where no other corner lies within."""
    polygon = polygon.astype(np.float64)
    flat = _projected(polygon - polygon[0])
    left, triangles = list(range(len(flat))), []
    while len(left) > 3:
        ring = flat[left]
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        area = _cross(ring - before, after - ring)
        for ear in np.argsort(-area, kind="stable"):
            if area[ear] <= 0.0 or not _holds_any(before[ear], ring[ear], after[ear], ring):
                break
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return np.array([*triangles, tuple(left)])


def _holds_any(a: np.ndarray, b: np.ndarray, c: np.ndarray, points: np.ndarray) -> bool:
    """Whether the triangle holds any of `points` `[N, 2]` other than its own corners."""
    sides = np.stack([_cross(end - start, points - start) for start, end in ((a, b), (b, c), (c, a))])
    own = (points == a).all(axis=1) | (points == b).all(axis=1) | (points == c).all(axis=1)
    return bool(((sides >= 0.0).all(axis=0) & ~own).any())


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _projected(polygon: np.ndarray) -> np.ndarray:
    """The polygon `[N, 3]` in its plane, `[N, 2]`, anticlockwise."""
    normal = _normals(polygon[None])[0]
    axis = int(np.argmax(np.abs(normal)))
    flat = polygon[:, [(axis + 1) % 3, (axis + 2) % 3]]
    return flat if normal[axis] >= 0.0 else flat * (1.0, -1.0)
