"""Texture coordinates of image nodes: the primvar, and the transform."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bokehguide.scene.usd.networks import Constants, category_of, connected_output, kind_of
from bokehguide.scene.usd.stage import Stage

UV = "st"
"""The primvar of texture coordinates without a reader."""
MAX_LINKS = 16
"""Nodes between an image and its primvar."""
FLIP = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])
Affine = tuple[float, float, float, float, float, float]


def read_coordinates(opened: Stage, image: Any, name: str) -> tuple[str, Affine]:
    """The primvar of the texture coordinates, and the transform of uvs with v downwards. name: the input of the image node."""
    matrix, fed = _of_image(Constants(opened, image), category_of(kind_of(image))), connected_output(image, name)
    uv_name = UV
    for _ in range(MAX_LINKS):
        if fed is None:
            break
        node, _ = fed
        category, given = category_of(kind_of(node)), Constants(opened, node)
        if category in PRIMVARS:
            uv_name = PRIMVARS[category](given)
            break
        step = _step(given, category)
        if step is None:
            opened.lose(f"texture coordinates of the type {category[:40]}: left out", str(node.GetPath()))
            break
        matrix = matrix @ step
        fed = next((found for each in FED if (found := connected_output(node, each)) is not None), None)
    with np.errstate(all="ignore"):
        turned = np.nan_to_num(FLIP @ matrix @ FLIP, posinf=0.0, neginf=0.0)
    a, b, c, d, e, f = turned[:2].ravel().tolist()
    return uv_name, (a, b, c, d, e, f)


FED = ("in", "texcoord", "in1")
"""Inputs of nodes that take texture coordinates."""
PRIMVARS = {
    "texcoord": lambda given: f"{UV}{index}" if (index := int(given.number("index", 0))) > 0 else UV,
    "geompropvalue": lambda given: str(given.value("geomprop", UV) or UV),
    "UsdPrimvarReader": lambda given: str(given.value("varname", UV) or UV),
}
"""The primvars of nodes that read one. Further sets of MaterialX are named st1, st2 and so on."""


def _of_image(given: Constants, category: str) -> np.ndarray:
    """The transform that an image node itself makes."""
    if category == "tiledimage":
        tiling, offset = given.pair("uvtiling", (1.0, 1.0)), given.pair("uvoffset", (0.0, 0.0))
        sizes = given.pair("realworldimagesize", (1.0, 1.0)), given.pair("realworldtilesize", (1.0, 1.0))
        ratio = sizes[1] / np.where(sizes[0] == 0.0, 1.0, sizes[0])
        return _scaled(ratio) @ _moved(-offset) @ _scaled(tiling)
    if category.startswith("gltf"):
        pivot, scale = given.pair("pivot", (0.0, 1.0)), given.pair("scale", (1.0, 1.0))
        offset = given.pair("offset", (0.0, 0.0)) * (-1.0, 1.0)
        order = int(given.number("operationorder", 0))
        return _placed(pivot, scale, -given.number("rotate", 0.0), offset, order)
    return np.eye(3)


def _step(given: Constants, category: str) -> np.ndarray | None:
    """The transform of a node; None for one that is no transform."""
    if category == "UsdTransform2d":
        turn = _turned(given.number("rotation", 0.0))
        return _moved(given.pair("translation", (0.0, 0.0))) @ turn @ _scaled(given.pair("scale", (1.0, 1.0)))
    if category == "place2d":
        pivot, offset, scale = given.pair("pivot", (0.0, 0.0)), given.pair("offset", (0.0, 0.0)), given.pair("scale", (1.0, 1.0))
        order = int(given.number("operationorder", 0))
        return _placed(pivot, 1.0 / np.where(scale == 0.0, 1.0, scale), given.number("rotate", 0.0), offset, order)
    if category == "rotate2d":
        return _turned(-given.number("amount", 0.0))
    if category in ("multiply", "divide"):
        pair = given.pair("in2", (1.0, 1.0))
        return _scaled(pair if category == "multiply" else 1.0 / np.where(pair == 0.0, 1.0, pair))
    if category in ("add", "subtract"):
        return _moved(given.pair("in2", (0.0, 0.0)) * (1.0 if category == "add" else -1.0))
    return np.eye(3) if category in ("dot", "convert") else None


def _placed(pivot: np.ndarray, scale: np.ndarray, clockwise: float, offset: np.ndarray, order: int) -> np.ndarray:
    """The transform of place2d, whose scale divides; `scale` multiplies. clockwise: degrees. order: 1 moves first."""
    turn = _turned(-clockwise)
    inner = _scaled(scale) @ turn @ _moved(-offset) if order == 1 else _moved(-offset) @ turn @ _scaled(scale)
    return _moved(pivot) @ inner @ _moved(-pivot)


def _scaled(scale: np.ndarray) -> np.ndarray:
    return np.diag([scale[0], scale[1], 1.0])


def _moved(offset: np.ndarray) -> np.ndarray:
    return np.array([[1.0, 0.0, offset[0]], [0.0, 1.0, offset[1]], [0.0, 0.0, 1.0]])


def _turned(degrees: float) -> np.ndarray:
    """A rotation anticlockwise."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
