"""Nodes of a shading network: their kinds, and the values and the nodes at their inputs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bokehguide.scene.usd.libraries import UsdShade
from bokehguide.scene.usd.stage import Stage

PREFIX = "ND_"
"""Start of the identifiers of MaterialX nodes."""


class Constants:
    """The constant inputs of a node."""

    def __init__(self, opened: Stage, node: Any):
        self._time, self._node = opened.time, node

    def value(self, name: str, default: Any) -> Any:
        """The value of an input, which may be that of an interface."""
        attribute = valued(self._node, name)
        value = None if attribute is None else attribute.Get(self._time)
        return default if value is None else value

    def number(self, name: str, default: float) -> float:
        """A finite number."""
        value = float(self.value(name, default))
        return value if math.isfinite(value) else default

    def pair(self, name: str, default: tuple[float, float]) -> np.ndarray:
        """Two finite numbers; a single one counts twice."""
        value = np.broadcast_to(np.asarray(self.value(name, default), np.float64), 2)
        return np.nan_to_num(value, posinf=0.0, neginf=0.0)


def kind_of(node: Any) -> str:
    """The identifier of a node, such as "UsdUVTexture" or "ND_image_color3"."""
    return str(node.GetIdAttr().Get())


def category_of(kind: str) -> str:
    """The category of a node by its identifier, such as "image" of ND_image_color3."""
    parts = kind.removeprefix(PREFIX).split("_")
    return "_".join(parts[: 2 if parts[0] == "gltf" else 1])


def valued(node: Any, name: str) -> Any:
    """The attribute with the value of an input; None if the input is absent or fed by another node."""
    given = node.GetInput(name)
    sources = given.GetValueProducingAttributes() if given else []
    return sources[0] if sources and sources[0].GetName().startswith("inputs:") else None


def connected_output(node: Any, name: str) -> tuple[Any, str] | None:
    """The shader that feeds an input, and the name of its output; None for an input without one."""
    given = node.GetInput(name)
    for attribute in given.GetValueProducingAttributes() if given else []:
        if UsdShade.Output.IsOutput(attribute):
            return UsdShade.Shader(attribute.GetPrim()), UsdShade.Output(attribute).GetBaseName()
    return None
