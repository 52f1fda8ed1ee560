"""Images of lights."""

from __future__ import annotations

from typing import Any

import numpy as np

from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.textures import Textures, decode


def light_image(opened: Stage, prim: Any, textures: Textures) -> np.ndarray | None:
    """The image of a light's `texture:file`, linear float32 `[H, W, 3]`; None without one. Raises as `Textures.data` does."""
    attribute = prim.GetAttribute("inputs:texture:file")
    data = textures.data(attribute) if attribute and attribute.HasValue() else None
    if data is None:
        return None
    name, files = str(attribute.Get(opened.time).path), opened.files
    return decode(data, name, opened.place(prim), files, srgb=True, alpha=False).clip(min=0.0)
