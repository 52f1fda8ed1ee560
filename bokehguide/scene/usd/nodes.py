"""Nodes of MaterialX in networks of UsdShade: images, constants, and arithmetic with both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bokehguide.color import srgb_to_linear
from bokehguide.limits import LARGEST
from bokehguide.scene.usd.networks import category_of, connected_output, kind_of, valued
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.textures import Source, Textures, is_srgb

WIDTHS = {"float": 1, "integer": 1, "boolean": 1, "color3": 3, "vector2": 2, "vector3": 3, "color4": 4, "vector4": 4}
IMAGES = ("image", "tiledimage", "gltf_image", "gltf_colorimage")
SAME = ("dot", "convert", "constant")
"""Nodes whose result is their input."""
CHANNELS = {name: index for index, names in enumerate(("rx0", "gy1", "bz2", "aw3")) for name in names}
LINEAR = ("lin_rec709", "lin_rec709_scene", "lin_srgb", "raw", "data", "none", "identity", "unknown")
SRGB = ("srgb_texture", "srgb_rec709_scene", "srgb")
POWERS = {"g22_rec709": 2.2, "g22_rec709_scene": 2.2, "g18_rec709": 1.8, "g18_rec709_scene": 1.8, "rec709_display": 2.4}
AP1_SPACES = ("acescg", "lin_ap1", "lin_ap1_scene")
AP1 = np.array(
    [
        [1.705050992658, -0.621792120657, -0.083258872001],
        [-0.130256417507, 1.140804736575, -0.010548319068],
        [-0.024003356805, -0.128968976065, 1.15297233287],
    ]
)
"""ACEScg to linear Rec.709, of the colour management of MaterialX."""
GEOMETRY = ("normal", "tangent", "bitangent")
"""Nodes that read the normal or the tangent of the surface, as an input without a connection does."""
MAX_DEPTH = 64
"""Nodes that feed each other."""
OTHERS = (*POWERS, *AP1_SPACES)
ADDRESSED = ("texcoord", "uaddressmode", "vaddressmode")
"""Inputs of image nodes of MaterialX."""
Operands = tuple[tuple[str, float], ...]
PAIR_0, PAIR_1 = (("in1", 0.0), ("in2", 0.0)), (("in1", 0.0), ("in2", 1.0))
OPERATIONS: dict[str, tuple[Operands, Callable[..., Any]]] = {
    "multiply": (PAIR_1, np.multiply),
    "divide": (PAIR_1, np.divide),
    "add": (PAIR_0, np.add),
    "subtract": (PAIR_0, np.subtract),
    "min": (PAIR_0, np.minimum),
    "max": (PAIR_0, np.maximum),
    "power": (PAIR_1, np.power),
    "invert": ((("in", 0.0), ("amount", 1.0)), lambda value, amount: amount - value),
    "clamp": ((("in", 0.0), ("low", 0.0), ("high", 1.0)), lambda value, low, high: np.minimum(np.maximum(value, low), high)),
    "mix": ((("fg", 0.0), ("bg", 0.0), ("mix", 0.0)), lambda fg, bg, mix: fg * mix + bg * (1.0 - mix)),
}
"""Arithmetic nodes: their inputs with defaults, and their function."""


@dataclass(frozen=True)
class Value:
    """A number or a colour of `len(factor)` channels: `factor`, times the texels of `source` where there is one."""

    factor: np.ndarray
    source: Source | None = None

    def __post_init__(self) -> None:
        factor = np.nan_to_num(np.atleast_1d(self.factor).astype(np.float64))
        object.__setattr__(self, "factor", factor.clip(-LARGEST, LARGEST))

    def channel(self, index: int) -> Value:
        """One channel."""
        index = min(index, len(self.factor) - 1)
        factor = self.factor[index : index + 1]
        if self.source is None or index >= self.source.image.shape[2]:  # images without alpha are opaque
            return Value(factor)
        return Value(factor, replace(self.source, image=self.source.image[..., index : index + 1]))

    def texels(self) -> np.ndarray:
        """The product, `[H, W, C]`, or `[C]` of a constant."""
        if self.source is None:
            return self.factor
        image, width = self.source.image, len(self.factor)
        if image.shape[2] < width:
            image = np.concatenate([image, np.ones((*image.shape[:2], width - image.shape[2]), np.float32)], axis=2)
        return image[..., :width] * self.factor.astype(np.float32)


class Nodes:
    """The values of the nodes of a stage, each found once."""

    def __init__(self, opened: Stage, textures: Textures):
        self._opened, self._textures = opened, textures
        self._known: dict[tuple[str, str], Value | None] = {}
        self._depth = 0

    def input(self, node: Any, name: str) -> Value | None:
        """The value of an input; None for one that is absent, and for one that cannot be read, with a note."""
        found = connected_output(node, name)
        if found is not None:
            return self.output(*found)
        attribute = valued(node, name)
        if attribute is None:
            return None
        value = attribute.Get(self._opened.time)
        if value is None or isinstance(value, str):
            return None
        try:
            numbers = np.array(value, np.float64).reshape(-1)
        except (TypeError, ValueError):
            return None
        if attribute.GetColorSpace() and len(numbers) in (3, 4):
            numbers[:3] = linear(numbers[:3], self._space(attribute, LINEAR[0]))
        return Value(numbers) if 1 <= len(numbers) <= 4 else None

    def output(self, node: Any, output: str) -> Value | None:
        """The value of an output of a node; None, with a note, where it cannot be read."""
        key = str(node.GetPath()), output
        if key not in self._known:
            self._known[key] = None  # of nodes that lead to themselves
            self._depth += 1
            if self._depth < MAX_DEPTH:
                self._known[key] = self._evaluate(node, output)
            else:
                self._opened.lose(f"chains of more than {MAX_DEPTH} nodes: left out", str(node.GetPath()))
            self._depth -= 1
        return self._known[key]

    def normal(self, node: Any, name: str) -> tuple[Source, float] | None:
        """The normal map at an input, and its scale; None without one."""
        found, scale, value = connected_output(node, name), 1.0, None
        if found is None:
            return None
        shader, output = found
        kind = kind_of(shader)
        category = category_of(kind)
        if category == "UsdUVTexture":
            source = self._textures.read(shader, output, normal=True)
            return None if source is None else (source, 1.0)
        if category == "normalmap":
            value, given = self.input(shader, "in"), self.input(shader, "scale")
            scale = 1.0 if given is None else float(given.factor[0])
        elif category == "gltf_normalmap":
            value = self._image(shader, category, output, 3)
        elif category not in GEOMETRY:
            self._opened.lose(f"nodes of the type {kind} at {name}: left out", str(node.GetPath()))
        if value is None or value.source is None or value.source.image.shape[2] < 3:
            return None
        return value.source, scale

    def combine(self, operation: str, name: str, *values: Value) -> Value:
        """The result of an arithmetic node. The first image counts, with a note that has `name`, if coordinates differ."""
        sources = [each.source for each in values if each.source is not None]
        width = max(len(each.factor) for each in values)
        if any(len(each.factor) not in (1, width) for each in values):
            self._opened.lose("nodes that combine values of different types: the first value counts", name)
            return values[0]
        if operation == "multiply" and len(sources) <= 1 and all(len(each.factor) == width for each in values if each.source):
            return Value(np.prod(np.broadcast_arrays(*(each.factor for each in values)), axis=0), *sources)
        for other in sources[1:]:
            if other.coordinates != sources[0].coordinates or other.image.shape[:2] != sources[0].image.shape[:2]:
                self._opened.lose("nodes that combine images of different coordinates or sizes: the first image counts", name)
                return next(each for each in values if each.source is not None)
        with np.errstate(all="ignore"):
            result = np.asarray(OPERATIONS[operation][1](*(each.texels() for each in values)))
        result = np.nan_to_num(result, posinf=0.0, neginf=0.0)
        if not sources:
            return Value(result)
        self._textures.reserve(result.size)
        return Value(np.ones(width), replace(sources[0], image=np.ascontiguousarray(result, np.float32)))

    def resized(self, value: Value, width: int) -> Value:
        """A value with another number of channels: a number fills all, and further channels are dropped, or are 1."""
        have, source = len(value.factor), value.source
        if have == width:
            return value
        factor = np.full(width, value.factor[0]) if have == 1 else np.append(value.factor, (1.0, 1.0))[:width]
        if source is None:
            return Value(factor)
        if have > 1:
            return Value(factor, replace(source, image=source.image[..., :width]))
        self._textures.reserve(width * source.image[..., 0].size)
        return Value(factor, replace(source, image=np.repeat(source.image[..., :1], width, axis=2)))

    def _evaluate(self, node: Any, output: str) -> Value | None:
        """The value of an output that is not known yet."""
        kind = kind_of(node)
        category, width = category_of(kind), next((WIDTHS[part] for part in kind.split("_")[::-1] if part in WIDTHS), 0)
        if category == "UsdUVTexture":
            source = self._textures.read(node, output)
            return None if source is None else self._preview_texture(source, output)
        if category in IMAGES:
            return self._image(node, category, output, width or 4)
        if category in SAME:
            value = self.input(node, "value" if category == "constant" else "in")
            return value if value is None or not width else self.resized(value, width)
        if category in OPERATIONS:
            operands, _ = OPERATIONS[category]
            given = [self.input(node, name) for name, _ in operands]
            values = [Value(np.asarray(default)) if each is None else each for each, (_, default) in zip(given, operands)]
            return self.combine(category, str(node.GetPath()), *values)
        if category == "extract" or category.startswith("separate"):
            value = self.input(node, "in")
            index = self.input(node, "index") if category == "extract" else None
            channel = CHANNELS.get(output[-1:], 0) if category != "extract" else 0 if index is None else int(index.factor[0])
            return None if value is None else value.channel(max(channel, 0))
        self._opened.lose(f"nodes of the type {kind}: the default of the input in their place", str(node.GetPath()))
        return None

    def _preview_texture(self, source: Source, output: str) -> Value:
        """The value of an output of a UsdUVTexture."""
        if output in ("rgb", "rgba"):
            return Value(np.ones(len(output)), source)
        image = source.grey()[..., None]
        return Value(np.ones(1), replace(source, image=image, channel=0))

    def _image(self, node: Any, category: str, output: str, width: int) -> Value | None:
        """The texels of an image node."""
        attribute, colored = valued(node, "file"), "color" in kind_of(node)
        space = self._space(attribute, "auto") if colored and attribute is not None else "raw"
        source = self._textures.image(node, lambda data: space in SRGB or (space == "auto" and is_srgb(data)), ADDRESSED)
        if source is None:
            return self.input(node, "default")
        image = source.image
        if space in OTHERS:
            self._textures.reserve(image.size)
            image = np.concatenate([linear(image[..., :3], space), image[..., 3:]], axis=2, dtype=np.float32)
        value = Value(np.ones(width), replace(source, image=image[..., :width]))
        factor = self.input(node, "color" if category == "gltf_colorimage" else "factor")
        if factor is not None:
            value = self.combine("multiply", str(node.GetPath()), value, factor)
        if category == "gltf_colorimage":
            return value.channel(3) if output == "outa" else self.resized(value, 3)
        return value

    def _space(self, attribute: Any, default: str) -> str:
        """The colour space of an attribute, or the nearest one, with a note."""
        space = str(attribute.GetColorSpace() or default).lower()
        if space in (*LINEAR, *SRGB, *OTHERS, "auto"):
            return space
        nearest = LINEAR[0] if space.startswith("lin") else SRGB[0]
        self._opened.lose(f"colour space {space[:40]}: {nearest} in its place", str(attribute.GetPath()))
        return nearest


def linear(rgb: np.ndarray, space: str) -> np.ndarray:
    """Colours `[..., 3]` of a colour space as linear Rec.709."""
    if space in SRGB:
        return srgb_to_linear(rgb)
    if space in POWERS:
        return rgb.clip(0.0) ** POWERS[space]
    return rgb @ AP1.T if space in AP1_SPACES else rgb
