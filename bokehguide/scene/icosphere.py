"""Icosahedra whose triangles are subdivided on the unit sphere."""

from __future__ import annotations

import math

import numpy as np

SHORT = math.sqrt(0.5 - math.sqrt(0.05))
LONG = math.sqrt(0.5 + math.sqrt(0.05))
POINTS = (
    *((-SHORT, LONG, 0.0), (SHORT, LONG, 0.0), (-SHORT, -LONG, 0.0), (SHORT, -LONG, 0.0)),
    *((0.0, -SHORT, LONG), (0.0, SHORT, LONG), (0.0, -SHORT, -LONG), (0.0, SHORT, -LONG)),
    *((LONG, 0.0, -SHORT), (LONG, 0.0, SHORT), (-LONG, 0.0, -SHORT), (-LONG, 0.0, SHORT)),
)
"""Corners of golden rectangles in the coordinate planes."""
TRIANGLES = (
    *((0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8)),
    *((3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)),
)


def icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the unit sphere, float64 `[V, 3]`, and triangles that face outwards, `[20 · 4^subdivisions, 3]`."""
    points, triangles = np.array(POINTS), np.array(TRIANGLES)
    for _ in range(subdivisions):
        ends = np.stack([triangles, np.roll(triangles, -1, axis=1)])
        keys, middles = np.unique(ends.max(axis=0) * len(points) + ends.min(axis=0), return_inverse=True)
        a, b, c = triangles.T
        ab, bc, ca = middles.reshape(-1, 3).T + len(points)
        triangles = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        new = points[np.stack(np.divmod(keys, len(points)))].mean(axis=0)
        points = np.concatenate([points, new / np.linalg.norm(new, axis=1, keepdims=True)])
    return points, triangles
