"""Transmission of apertures by plain geometry."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import map_coordinates

from bokehguide.scene.types import Aperture

RADIUS = 0.1
"""Radius of the lens of `plain_transmission`, metres."""


def plain_transmission(shape: Aperture, points: np.ndarray) -> np.ndarray:
    """W at lens points `[2, N]`, except for a factor: of an intersection of discs or half planes, or of a mask."""
    x, y = points[0] * shape.ratio / RADIUS, points[1] / RADIUS
    turn = math.radians(shape.rotation)
    x, y = math.cos(turn) * x + math.sin(turn) * y, math.cos(turn) * y - math.sin(turn) * x
    if shape.image is not None:
        pitch = 2.0 / max(shape.image.shape)
        rows, columns = shape.image.shape[0] / 2.0 - y / pitch - 0.5, shape.image.shape[1] / 2.0 + x / pitch - 0.5
        return map_coordinates(np.pad(shape.image.astype(float), 2), (rows + 2.0, columns + 2.0), order=1)
    distance, direction = np.hypot(x, y), np.arctan2(y, x)
    low, high = np.zeros_like(x), np.full_like(x, 2.0)
    for _ in range(30):  # the rim in each point's direction
        middle = 0.5 * (low + high)
        inside = _within(shape, middle * np.cos(direction), middle * np.sin(direction))
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    t = distance / low
    return (t <= 1.0) * (1.0 + shape.edge * (2.0 * t**2 - 1.0))


def _within(shape: Aperture, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether points lie in the disc of every blade: all blades' circles pass through two corners."""
    if shape.blades == 0:
        return np.hypot(x, y) <= 1.0
    inside = np.ones(x.shape, bool)
    half = math.pi / shape.blades
    for middle in 2.0 * half * np.arange(shape.blades):
        along, across = np.cos(middle) * x + np.sin(middle) * y, np.cos(middle) * y - np.sin(middle) * x
        if shape.curvature == 0.0:
            inside &= along <= math.cos(half)
            continue
        radius = 1.0 / shape.curvature
        centre = math.cos(half) - math.sqrt(radius**2 - math.sin(half) ** 2)
        inside &= np.hypot(along - centre, across) <= radius
    return inside
