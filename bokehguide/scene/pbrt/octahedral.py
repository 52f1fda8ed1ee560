"""Environment maps of pbrt as equirectangular maps.

Those of pbrt-v4 are squares that show the sphere in equal areas. Such a map unfolds an octahedron: its centre is +z, its corners
are -z (Clarberg 2008, Fast Equal-Area Mapping of the (Hemi)Sphere using SIMD).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

MAX_HEIGHT = 2048
"""Rows of an equirectangular map; that of a small one has twice the rows of the square, so that its peaks stay sharp."""
SHARP_HEIGHT = 512
"""Rows up to which the map of an equirectangular one has twice the rows, so that its peaks stay sharp."""
STEPS = 2
"""Samples along the side of each texel."""


def square_from_sphere(directions: np.ndarray) -> np.ndarray:
    """Points of the square `[..., 2]`, from 0 to 1, of unit directions `[..., 3]`."""
    x, y, z = np.moveaxis(np.abs(directions), -1, 0)
    radius = np.sqrt((1.0 - z).clip(min=0.0))
    angle = np.arctan2(np.minimum(x, y), np.maximum(x, y)) * (2.0 / np.pi)
    angle = np.where(x < y, 1.0 - angle, angle)
    v = angle * radius
    u = radius - v
    below = directions[..., 2] < 0.0
    u, v = np.where(below, 1.0 - v, u), np.where(below, 1.0 - u, v)
    signed = np.stack([np.copysign(u, directions[..., 0]), np.copysign(v, directions[..., 1])], axis=-1)
    return 0.5 * (signed + 1.0)


def sphere_from_square(points: np.ndarray) -> np.ndarray:
    """Unit directions `[..., 3]` of points of the square `[..., 2]`, from 0 to 1."""
    u, v = np.moveaxis(2.0 * points - 1.0, -1, 0)
    signed = 1.0 - (np.abs(u) + np.abs(v))
    radius = 1.0 - np.abs(signed)
    turn = (np.abs(v) - np.abs(u)) / np.where(radius == 0.0, 1.0, radius)
    phi = (np.where(radius == 0.0, 0.0, turn) + 1.0) * (np.pi / 4.0)
    z = np.copysign(1.0 - radius**2, signed)
    flat = radius * np.sqrt((2.0 - radius**2).clip(min=0.0))
    return np.stack([np.copysign(np.cos(phi), u) * flat, np.copysign(np.sin(phi), v) * flat, z], axis=-1)


def equirectangular(image: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """The equirectangular map float32 `[H, 2 H, 3]` of an octahedral one `[N, N, 3]`, with the same mean over the sphere.

    turn: the matrix `[3, 3]` from directions of the world to those of the map.
    """
    height = min(max(2 * len(image), 16), MAX_HEIGHT)
    return _resampled(lambda local: bilinear(image, square_from_sphere(local)), height, turn, image.mean(axis=(0, 1)))


def turned(image: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """The equirectangular map float32 `[H, 2 H, 3]` of another `[h, w, 3]`, whose top is +z and whose left edge is +x.

    The columns of the other map turn from +x to +y, as in pbrt-v3. The mean over the sphere stays. turn: as in `equirectangular`.
    """
    rows = np.sin(np.pi * (np.arange(len(image)) + 0.5) / len(image))
    mean = np.average(image.mean(axis=1), axis=0, weights=rows)
    height = min(max(len(image), min(2 * len(image), SHARP_HEIGHT), 16), MAX_HEIGHT)
    return _resampled(lambda local: _nearest(image, local), height, turn, mean)


def _nearest(image: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The nearest texels `[..., 3]` of an equirectangular map with +z at its top, at unit directions `[..., 3]`."""
    height, width = image.shape[:2]
    row = np.arccos(directions[..., 2].clip(-1.0, 1.0)) / np.pi * height
    column = np.arctan2(directions[..., 1], directions[..., 0]) / (2.0 * np.pi) % 1.0 * width
    return image[row.astype(np.int64).clip(0, height - 1), column.astype(np.int64) % width]


def _resampled(sampled: Callable[[np.ndarray], np.ndarray], height: int, turn: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """An equirectangular map float32 `[height, 2 height, 3]`, scaled to the mean `wanted` `[3]` over the sphere.

    sampled: the radiance `[..., 3]` at unit directions `[..., 3]` of another map, to which `turn` `[3, 3]` leads.
    """
    found = np.zeros((height, 2 * height, 3), np.float64)
    offsets = (np.arange(STEPS) + 0.5) / STEPS
    phi = 2.0 * np.pi * (np.arange(2 * height)[:, None] + offsets).reshape(-1) / (2 * height) - np.pi
    for row in range(height):
        theta = np.pi * (row + offsets[:, None]) / height
        directions = np.stack(
            np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)), axis=-1
        )
        local = directions @ turn.T
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        found[row] = sampled(local).reshape(STEPS, 2 * height, STEPS, 3).mean(axis=(0, 2))
    weights = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    means = np.average(found.mean(axis=1), axis=0, weights=weights)
    return (found * np.where(means > 0.0, wanted / np.where(means > 0.0, means, 1.0), 1.0)).astype(np.float32)


def bilinear(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bilinear samples `[..., 3]` at points of the square `[..., 2]`; neighbours beyond an edge lie across it on the sphere."""
    size = len(image)
    position = points * size - 0.5
    low = np.floor(position).astype(np.int64)
    share = position - low
    total = np.zeros((*points.shape[:-1], 3))
    for x in (0, 1):
        for y in (0, 1):
            column, row = _across(low[..., 0] + x, low[..., 1] + y, size)
            weight = np.abs(1.0 - x - share[..., 0]) * np.abs(1.0 - y - share[..., 1])
            total += weight[..., None] * image[row, column]
    return total


def _across(column: np.ndarray, row: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels at most one beyond an edge as those of the other half of the edge."""
    beyond = (column < 0) | (column >= size)
    row = np.where(beyond, size - 1 - row, row)
    column = column.clip(0, size - 1)
    beyond = (row < 0) | (row >= size)
    column = np.where(beyond, size - 1 - column, column)
    return column, row.clip(0, size - 1)


def upper_illuminance(image: np.ndarray, luminance: np.ndarray) -> float:
    """The illuminance of a surface that faces the map's +z, as pbrt-v4 computes it: half of the integral. image: `[N, N, 3]`."""
    middles = (np.arange(len(image)) + 0.5) / len(image)
    cosine = sphere_from_square(np.stack(np.meshgrid(middles, middles), axis=-1))[..., 2].clip(min=0.0)
    return float(2.0 * math.pi * ((image @ luminance) * cosine).sum() / (len(image) ** 2))
