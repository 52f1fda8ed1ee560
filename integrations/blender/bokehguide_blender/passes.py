"""The passes of a render in Blender. Importing needs no Blender."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import bpy

MATTES = {"use_pass_cryptomatte_object": "CryptoObject", "use_pass_cryptomatte_material": "CryptoMaterial"}
"""Cryptomatte layers by the settings of a view layer."""
MATTE_PASSES = 3
"""Passes of a Cryptomatte layer, each with two ranks, that bokehguide has."""


class Pass(NamedTuple):
    """A pass: its name, the names of its channels, and Blender's type of its content."""

    name: str
    channels: str
    content: str


def passes_of(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, light_groups: Mapping[str, str]) -> Iterator[Pass]:
    """The passes that a render of a view layer delivers. light_groups: names of their passes by key."""
    yield Pass("Combined", "RGBA", "COLOR")
    if layer.use_pass_z:
        yield Pass("Depth", "Z", "VALUE")
    if layer.use_pass_normal:
        yield Pass("Normal", "XYZ", "VECTOR")
    if scene.bokehguide.use_pass_albedo:
        yield Pass("Albedo", "RGB", "COLOR")
    for setting, name in MATTES.items():
        if getattr(layer, setting):
            count = min((layer.pass_cryptomatte_depth + 1) // 2, MATTE_PASSES)
            yield from (Pass(f"{name}{number:02}", "rgba", "COLOR") for number in range(count))
    for name in light_groups.values():
        yield Pass(name, "RGB", "COLOR")


class Passes:
    """Fills the passes of a view layer.

    size: width and height of the picture in pixels. opaque: as of `planes_of`. light_groups: names of their passes by key.
    """

    def __init__(
        self, engine: bpy.types.RenderEngine, layer: str, size: tuple[int, int], opaque: bool, light_groups: Mapping[str, str]
    ):
        self._engine, self._layer, self._size, self._opaque = engine, layer, size, opaque
        self._light_groups = light_groups

    def show(self, path: Path) -> None:
        """Show a picture of the driver, and remove its file."""
        with np.load(path) as layers:
            planes = planes_of(dict(layers), self._opaque, self._light_groups)
        path.unlink()
        result = self._engine.begin_result(0, 0, *self._size, layer=self._layer)
        passes = result.layers[0].passes
        for name, plane in planes.items():
            if name in passes:
                passes[name].rect.foreach_set(plane)
        self._engine.end_result(result)

    def describe(self, metadata: Mapping[str, str]) -> None:
        """Add metadata of the driver to the render."""
        result = self._engine.get_result()
        for name, value in metadata.items():
            result.stamp_data_add_field(name, value)


def planes_of(
    layers: dict[str, np.ndarray], opaque: bool = False, light_groups: Mapping[str, str] | None = None
) -> dict[str, np.ndarray]:
    """Passes by name, flat and bottom row first, in Blender's axes, of the layers of a picture, top row first.

    opaque: whether the alpha is 1 everywhere, as in Cycles without *Transparent*; bokehguide has no black world. light_groups:
    names of their passes by layer.
    """
    color = layers.get("denoised", layers["beauty"])
    alpha = np.ones_like(layers["alpha"]) if opaque else layers["alpha"]
    x, y, z = np.moveaxis(layers["normal"], -1, 0)
    planes = {
        "Combined": np.concatenate((color, alpha[..., None]), axis=-1),
        "Depth": layers["depth"],
        "Normal": np.stack((x, -z, y), axis=-1),
        "Albedo": layers["albedo"],
    }
    planes |= {name: layer for name, layer in layers.items() if name.startswith(tuple(MATTES.values()))}
    planes |= {name: layers[key] for key, name in (light_groups or {}).items() if key in layers}
    return {name: np.ascontiguousarray(plane[::-1], np.float32).ravel() for name, plane in planes.items()}
