"""The passes of a render in Blender. Importing needs no Blender."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import bpy


class Passes:
    """Fills the passes of a view layer. size: width and height of the picture in pixels. opaque: as of `planes_of`."""

    def __init__(self, engine: bpy.types.RenderEngine, layer: str, size: tuple[int, int], opaque: bool):
        self._engine, self._layer, self._size, self._opaque = engine, layer, size, opaque

    def show(self, path: Path) -> None:
        """Show a picture of the driver, and remove its file."""
        with np.load(path) as layers:
            planes = planes_of(dict(layers), self._opaque)
        path.unlink()
        result = self._engine.begin_result(0, 0, *self._size, layer=self._layer)
        passes = result.layers[0].passes
        for name, plane in planes.items():
            if name in passes:
                passes[name].rect.foreach_set(plane)
        self._engine.end_result(result)


def planes_of(layers: dict[str, np.ndarray], opaque: bool = False) -> dict[str, np.ndarray]:
    """Passes by name, flat and bottom row first, in Blender's axes, of the layers of a picture, top row first.

    opaque: whether the alpha is 1 everywhere, as in Cycles without *Transparent*; bokehguide has no black world.
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
    return {name: np.ascontiguousarray(plane[::-1], np.float32).ravel() for name, plane in planes.items()}
