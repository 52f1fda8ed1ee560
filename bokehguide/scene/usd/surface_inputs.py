"""Inputs of surface nodes: numbers, colours, images, and textures that are made of images."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bokehguide.limits import LARGEST
from bokehguide.scene.images import nearest_texels
from bokehguide.scene.types import Material, Texture
from bokehguide.scene.usd.networks import PREFIX, connected_output, kind_of
from bokehguide.scene.usd.nodes import Nodes, Value
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.textures import Source, Textures

DISPLAY_COLOR = "displayColor"
READERS = {
    "UsdPrimvarReader_float3": "varname",
    "UsdPrimvarReader_vector3": "varname",
    "geompropvalue_color3": "geomprop",
    "geomcolor_color3": "",
}
"""Nodes that read a primvar of colours, and their inputs for its name."""
WHITE = (1.0, 1.0, 1.0)
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Look:
    """A material, the primvars of its texture coordinates, and that of its colours, "" without one."""

    material: Material
    uv_names: tuple[str, ...] = ()
    colors: str = ""


class SurfaceInputs:
    """The inputs of a surface node. uv_names: primvars of its textures. colors: the primvar of vertex colours, "" without one."""

    def __init__(self, opened: Stage, shader: Any, textures: Textures, nodes: Nodes, name: str):
        self.opened, self.shader, self.textures, self.nodes, self.name = opened, shader, textures, nodes, name
        self.uv_names: list[str] = []
        self.colors = ""

    def constant(self, name: str) -> Value | None:
        """The constant of an input, also of one that nodes of MaterialX feed; None without one."""
        found = connected_output(self.shader, name)
        if found is not None and not kind_of(found[0]).startswith(PREFIX):
            return None
        value = self.nodes.input(self.shader, name)
        return value if value is not None and value.source is None else None

    def folded(self, value: Value | None) -> Source | None:
        """The image of a value, times its factor; None without an image."""
        if value is None or value.source is None or (value.factor == 1.0).all():
            return None if value is None else value.source
        self.textures.reserve(value.source.image.size)
        return replace(value.source, image=np.ascontiguousarray(value.texels(), np.float32), channel=0)

    def normal_map(self, name: str, prefix: str = "") -> dict[str, Any]:
        """The fields of a normal map. prefix: of their names."""
        found = self.nodes.normal(self.shader, name)
        if found is None:
            return {}
        source, scale = found
        return {f"{prefix}normal_texture": source.texture(source.image[..., :3], self.uv_names), f"{prefix}normal_scale": scale}

    def primvar(self, name: str) -> str:
        """The primvar of colours that feeds an input, "" for none."""
        found = connected_output(self.shader, name)
        kind = "" if found is None else kind_of(found[0]).removeprefix(PREFIX)
        for start, key in READERS.items():
            if found is not None and kind.startswith(start):
                varname = found[0].GetInput(key) if key else None
                return str((varname.Get(self.opened.time) if varname else None) or DISPLAY_COLOR)
        return ""

    def whole(self, image: Source | None) -> Texture | None:
        """A texture of all colour channels."""
        return None if image is None else image.texture(self.textures.colors(image), self.uv_names)

    def emission(self, image: Source) -> dict[str, Any]:
        """The fields of an emission texture, which has a maximum of 1."""
        self.textures.reserve(2 * image.image.size)
        pixels = image.rgb().clip(0.0, LARGEST)
        peak = max(float(pixels.max()), 1.0)
        emission = (peak,) * 3 if pixels.any() else BLACK
        return {"emission": emission, "emission_texture": image.texture(pixels / np.float32(peak), self.uv_names)}

    def with_alpha(self, color: Source | None, alpha: Source) -> Texture:
        """A texture of the colours of an image, white without one, and of the opacity of another one."""
        values = alpha.grey().clip(0.0, 1.0)
        if color is None:
            rgb, source = np.ones((*values.shape, 3), np.float32), alpha
        else:
            rgb, source = self.textures.colors(color), color
            self._compare(color, alpha)
        self.textures.reserve(2 * rgb.size)
        return source.texture(np.concatenate([rgb, nearest_texels(values, *rgb.shape[:2])[..., None]], axis=2), self.uv_names)

    def joined(self, sources: list[Source | None]) -> Texture:
        """A texture whose channels come from images; 1 where there is none."""
        given = [source for source in sources if source is not None]
        shape = max((source.image.shape[:2] for source in given), key=math.prod)
        first = given[0]
        for other in given[1:]:
            self._compare(first, other)
        stored = all(each.image is first.image and each.channel == sources.index(each) for each in given)
        if len(given) > 1 and stored and first.image.min() >= 0.0 and first.image.max() <= 1.0:
            return first.texture(first.image, self.uv_names)
        image = np.ones((*shape, max(3, len(sources))), np.float32)
        self.textures.reserve(image.size)
        for channel, source in enumerate(sources):
            if source is not None:
                image[..., channel] = nearest_texels(source.grey(), *shape).clip(0.0, 1.0)
        return first.texture(image, self.uv_names)

    def _compare(self, first: Source, other: Source) -> None:
        """Note a loss if two images that become one have different coordinates."""
        if first.coordinates != other.coordinates:
            self.opened.lose("textures with different coordinates that share one image: those of the first count", self.name)
