"""Images and colours of Mitsuba's properties."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import FLOATS, checks, float_texture, load_texture
from bokehguide.scene.mitsuba_xml.tree import Plugin, as_dictionary, file_of, mitsuba
from bokehguide.scene.types import Texture, Vector, as_vector

GREY = (0.5, 0.5, 0.5)
WRAPS = ("repeat", "mirror", "clamp")


class Textures:
    """The textures of a file. lose: notes a loss, in words, with the name of its object."""

    def __init__(self, file: Path, files: SceneFiles, lose: Callable[[str, str], None]):
        self._file, self._files, self._lose = file, files, lose

    def read(self, texture: Plugin, srgb: bool = True) -> Texture | None:
        """A bitmap or a checkerboard; None for another texture."""
        if not is_image(texture):
            self._lose(f"texture {texture.type}: left out", texture.label)
            return None
        image = self._checks(texture) if texture.type == "checkerboard" else self._bitmap(texture, srgb)
        given, matrix = texture.text("wrap_mode", "repeat"), texture.matrix("to_uv")
        wrap = given if given in WRAPS else "repeat"
        return Texture(image, wrap=(wrap, wrap), transform=tuple(matrix[[0, 0, 0, 1, 1, 1], [0, 1, 3, 0, 1, 3]].tolist()))

    def _bitmap(self, texture: Plugin, srgb: bool) -> np.ndarray:
        """The pixels of a file, linear float32 `[H, W, 3]`."""
        path = file_of(texture, self._file, self._files, "texture")
        raw = not srgb or texture.flag("raw")
        if path.suffix.lower() in FLOATS:
            return float_texture(path, self._files, str(path))
        return load_texture(path, self._files, not raw)

    def _checks(self, texture: Plugin) -> np.ndarray:
        """A checkerboard, linear float32 `[H, W, 3]`."""
        given = [texture.values.get(key, default) for key, default in (("color0", 0.4), ("color1", 0.2))]
        colors = [color_of(value, texture.place) for value in given]
        if None in colors:
            self._lose("textures in a checkerboard: grey in their place", texture.label)
        image = checks(*(np.array(color or GREY, np.float32).clip(min=0.0) for color in colors))
        self._files.reserve(image.size, 0, texture.place)
        return image


def is_image(value: Any) -> TypeGuard[Plugin]:
    """Whether a property is an image of a file or a checkerboard."""
    if not isinstance(value, Plugin):
        return False
    return value.type == "checkerboard" or (value.type == "bitmap" and isinstance(value.values.get("filename"), str))


def kind_of(value: Any) -> str:
    """The plugin of a property that is a plugin or a spectrum."""
    return value.type if isinstance(value, Plugin) else "spectrum"


def color_of(value: Any, place: str, light: bool = False) -> Vector | None:
    """A colour as linear RGB, that of spectra by Mitsuba itself. None for a texture, and for a spectrum without a colour there.

    light: whether the colour is that of an emitter. place: of the plugin, for errors.
    """
    if isinstance(value, (int, float)):
        return float(value), float(value), float(value)
    if isinstance(value, tuple) and len(value) == 3:
        return as_vector(value)
    plain = as_dictionary(value)
    if plain is None:
        return None
    with mitsuba(place) as mi:
        at = mi.SurfaceInteraction3f()
        at.wi = mi.Vector3f(0.0, 0.0, 1.0)
        try:
            if light:
                found = mi.load_dict({"type": "constant", "radiance": plain}).eval(at)
            else:
                found = mi.load_dict({"type": "diffuse", "reflectance": plain}).eval_diffuse_reflectance(at)
        except (RuntimeError, TypeError, ValueError):
            return None
        return as_vector(float(channel) for channel in np.ravel(np.array(found)))


def mean_of(value: Any) -> float:
    """The mean of a colour or of a spectrum, 0.5 for anything else."""
    values = getattr(value, "values", value)
    values = values() if callable(values) else values
    try:
        mean = float(np.mean(np.asarray(values, np.float64)))
    except (TypeError, ValueError):
        return 0.5
    return mean if math.isfinite(mean) else 0.5
