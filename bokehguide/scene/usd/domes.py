"""Dome lights as environment maps.

The top pole of a latitude-longitude map lies at +y of a dome, its centre at +z, and its left quarter at +x. The pole of a
DomeLight_1 may lie along z instead.
"""

from __future__ import annotations

import math

import numpy as np

from bokehguide.limits import LARGEST
from bokehguide.scene.environments import constant_radiance
from bokehguide.scene.types import Environment
from bokehguide.scene.usd.images import light_image
from bokehguide.scene.usd.libraries import UsdGeom
from bokehguide.scene.usd.lights import radiance_of
from bokehguide.scene.usd.prims import Placed
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.textures import Textures

DOMES = ("DomeLight", "DomeLight_1")
LATLONG = ("automatic", "latlong")
POLE_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""The turn by 90 degrees about x that brings +y to +z."""
HALF_TURN = np.diag([-1.0, 1.0, -1.0])
"""From the space of an environment map, whose centre lies at -z, to that of a dome."""


def read_dome(opened: Stage, placed: Placed, textures: Textures) -> Environment:
    """A dome light as an environment."""
    prim = placed.prim
    radiance = np.asarray(radiance_of(opened, prim, 4.0 * math.pi), np.float32)
    image = light_image(opened, prim, textures)
    if image is not None and str(prim.GetAttribute("inputs:texture:format").Get(opened.time)) not in LATLONG:
        opened.lose("maps of dome lights that are not latitude-longitude maps: the mean colour in their place", placed.name)
        image = image.mean(axis=(0, 1), keepdims=True)
    if image is None:
        return Environment(constant_radiance(radiance))
    turn = _orthogonal(placed.matrices[0][:3, :3]) @ _pole(opened, placed) @ HALF_TURN
    with np.errstate(over="ignore", invalid="ignore"):
        image = np.minimum(image * radiance, np.float32(LARGEST))
    if np.allclose(turn[:, 1], (0.0, 1.0, 0.0), atol=1e-5) and np.linalg.det(turn) > 0.0:
        return Environment(image, math.degrees(math.atan2(turn[0, 2], turn[2, 2])))
    return Environment(turned_map(image, turn))


def _pole(opened: Stage, placed: Placed) -> np.ndarray:
    """The turn `[3, 3]` that brings the pole at +y to the pole axis of a dome."""
    axis = placed.prim.GetAttribute("poleAxis").Get() if placed.prim.GetTypeName() == "DomeLight_1" else "Y"
    if axis == "scene":
        axis = UsdGeom.GetStageUpAxis(opened.stage)
    return POLE_TO_Z if axis == "Z" else np.eye(3)


def _orthogonal(matrix: np.ndarray) -> np.ndarray:
    """The rotation or reflection `[3, 3]` nearest to a matrix; the identity for one that is not finite."""
    if not np.isfinite(matrix).all():
        return np.eye(3)
    left, _, right = np.linalg.svd(matrix)
    return left @ right


def turned_map(image: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """An environment map `[H, W, 3]` under an orthogonal matrix `[3, 3]`, sampled bilinearly."""
    height, width = image.shape[:2]
    result = np.empty_like(image)
    phi = 2.0 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    for row in range(height):
        theta = np.pi * (0.5 - (row + 0.5) / height)
        directions = np.stack([np.cos(theta) * np.sin(phi), np.full(width, np.sin(theta)), -np.cos(theta) * np.cos(phi)], axis=1)
        x, y, z = (directions @ turn).T
        u = (np.arctan2(x, -z) / (2.0 * np.pi) + 0.5) * width - 0.5
        v = np.clip((0.5 - np.arcsin(y.clip(-1.0, 1.0)) / np.pi) * height - 0.5, 0.0, height - 1.0)
        left, top = np.floor(u).astype(int), np.floor(v).astype(int)
        right, below = (u - left)[:, None], (v - top)[:, None]
        rows, columns = (top, np.minimum(top + 1, height - 1)), (left % width, (left + 1) % width)
        upper, lower = ((1.0 - right) * image[each, columns[0]] + right * image[each, columns[1]] for each in rows)
        result[row] = (1.0 - below) * upper + below * lower
    return result
