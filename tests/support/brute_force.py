"""Rays against every triangle, in float64: what Embree's answers are compared with."""

from __future__ import annotations

import numpy as np


def every_hit(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances, infinite where there is no hit, and barycentric u and v, all `[N, T]` (Möller and Trumbore 1997).

    corners: `[T, 3, 3]`, corner before component; origins, directions: `[3, N]`.
    """
    a, b, c = (corners[:, i].astype(np.float64)[None] for i in range(3))
    origin, direction = origins.T[:, None].astype(np.float64), directions.T[:, None].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.cross(direction, c - a)
        scale = 1.0 / np.sum((b - a) * p, axis=2)
        u = np.sum((origin - a) * p, axis=2) * scale
        q = np.cross(origin - a, b - a)
        v = np.sum(direction * q, axis=2) * scale
        t = np.sum((c - a) * q, axis=2) * scale
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf), u, v
