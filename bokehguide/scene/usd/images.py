"""Images of lights."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

import numpy as np

from bokehguide.scene.images import decode_texture
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.textures import Textures, read_floats

FLOATS = (".exr", ".hdr")


def light_image(opened: Stage, prim: Any, textures: Textures) -> np.ndarray | None:
    """The image of a light's `texture:file`, linear float32 `[H, W, 3]`; None without one. Raises as `Textures.data` does."""
    attribute = prim.GetAttribute("inputs:texture:file")
    data = textures.data(attribute) if attribute and attribute.HasValue() else None
    if data is None:
        return None
    kind, place = PurePosixPath(attribute.Get(opened.time).path.rstrip("]")).suffix.lower(), opened.place(prim)
    if kind in FLOATS:
        return opened.files.image(data, False, False, lambda: read_floats(data, kind, place, opened.files)).clip(min=0.0)
    return decode_texture(data, place, opened.files, srgb=True)
