"""Textures of pbrt as images: of a file, constant, or computed from others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.images import FLOATS, checks, float_texture, load_texture, nearest_texels
from bokehguide.scene.pbrt.contents import Contents
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.pbrt.pfm import read_pfm
from bokehguide.scene.pbrt.spectra import reflectance
from bokehguide.scene.tables import did_you_mean
from bokehguide.scene.types import Texture

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
MAX_NESTING = 16
"""Textures that refer to each other; a cycle has more."""
WRAPS = {"repeat": "repeat", "clamp": "clamp", "black": "clamp", "octahedralsphere": "clamp"}


@dataclass(frozen=True)
class Value:
    """An image, linear `[H, W, C]` with 1 or 3 channels, float32; constants have one texel, float64.

    wrap, transform: as in `Texture`.
    """

    image: np.ndarray
    wrap: str = "repeat"
    transform: tuple[float, float, float, float, float, float] = IDENTITY

    @property
    def constant(self) -> bool:
        """Whether the value is the same everywhere."""
        return self.image.shape[:2] == (1, 1)

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> Value:
        """The value after a function of the texels."""
        return replace(self, image=function(self.image))


def constant(*channels: float) -> Value:
    """A value that is the same everywhere."""
    return Value(np.array(channels, np.float64).reshape(1, 1, -1))


class Textures:
    """The textures of a scene, each computed once."""

    def __init__(self, contents: Contents, folder: Path, files: SceneFiles):
        self._contents, self._folder, self._files = contents, folder, files
        self._known: dict[tuple[str, str], Value] = {}
        self._open: list[tuple[str, str]] = []

    def color(self, parameters: Parameters, key: str, default: float) -> Value:
        """The colours of a parameter that may name a texture, 3 channels of 0 or more."""
        name = parameters.texture(key)
        if name is not None:
            return self._named("spectrum", name, parameters)
        return constant(*reflectance(parameters, key, (default, default, default), self._folder, self._files))

    def scalar(self, parameters: Parameters, key: str, default: float) -> Value:
        """The numbers of a parameter that may name a texture, 1 channel."""
        name = parameters.texture(key)
        return constant(parameters.number(key, default)) if name is None else self._named("float", name, parameters)

    def on_surface(self, value: Value) -> Texture:
        """A value as the texture of a material. Raises BokehguideError if the scene's images exceed their budget."""
        self._files.reserve(value.image.size, 0, str(self._folder))
        return Texture(np.asarray(value.image, np.float32), wrap=(value.wrap, value.wrap), transform=value.transform)

    def load(self, name: str, place: str, srgb: bool) -> np.ndarray:
        """The pixels of an image file, linear `[H, W, 3]`."""
        path = self._files.find(self._folder, name, place)
        if path.suffix.lower() == ".pfm":
            return read_pfm(path, self._files, place)
        require_file(path, "texture", place)
        if path.suffix.lower() in FLOATS:
            return float_texture(path, self._files, str(path))
        return load_texture(path, self._files, srgb)

    def _named(self, value: str, name: str, parameters: Parameters) -> Value:
        """A texture by name."""
        key = (value, name)
        found = self._contents.textures.get(key)
        if found is None:
            names = [each for kind, each in self._contents.textures if kind == value]
            known = did_you_mean(name, names) if names else "define it"
            parameters.place.fail(f"{parameters.kind}: no {value} texture {printable(name)!r}; {known}")
        if key in self._open or len(self._open) >= MAX_NESTING:
            found.parameters.place.fail(
                f"the texture {printable(name)!r} refers to itself, or to too many others; break the chain"
            )
        if key not in self._known:
            self._open.append(key)
            make = MAKERS.get(found.parameters.kind)
            self._known[key] = self._lost(found.parameters, value) if make is None else make(self, found.parameters, value)
            self._open.pop()
            self._files.reserve(self._known[key].image.size, 0, str(found.parameters.place))
        return self._known[key]

    def _lost(self, parameters: Parameters, value: str) -> Value:
        self._contents.lose(f"texture {printable(parameters.kind)}: grey in its place", parameters.place.short)
        return constant(*(0.5,) * (1 if value == "float" else 3))

    def _part(self, parameters: Parameters, key: str, value: str, default: float) -> Value:
        return self.scalar(parameters, key, default) if value == "float" else self.color(parameters, key, default)

    def _mapped(self, image: np.ndarray, parameters: Parameters, wrap: str) -> Value:
        """An image with the mapping of its texture, whose v points upwards."""
        if parameters.text("mapping", "uv") != "uv":
            self._contents.lose("texture mappings other than uv: uv in their place", parameters.text("mapping"))
        su, sv, du, dv = (
            parameters.number(key, default)
            for key, default in (("uscale", 1.0), ("vscale", 1.0), ("udelta", 0.0), ("vdelta", 0.0))
        )
        return Value(image, wrap, (su, 0.0, du, 0.0, sv, 1.0 - sv - dv))

    def _constant(self, parameters: Parameters, value: str) -> Value:
        return self._part(parameters, "value", value, 1.0)

    def _imagemap(self, parameters: Parameters, value: str) -> Value:
        name = parameters.text("filename")
        encoding = parameters.text("encoding", "sRGB").lower().split()
        encoded = self._contents.older or name.lower().endswith(".png")
        image = self.load(name, str(parameters.place), not encoded or encoding[:1] == ["srgb"])
        if encoded and encoding[:1] == ["gamma"] and len(encoding) == 2:
            try:
                image = image ** min(max(float(encoding[1]), 0.1), 10.0)
            except ValueError:
                parameters.fail("encoding", 'is none; give "sRGB", "linear" or "gamma" with a number')
        if value == "float":
            image = image.mean(axis=2, keepdims=True)
        image = image * parameters.number("scale", 1.0)
        image = (1.0 - image if parameters.flag("invert") else image).clip(min=0.0)
        wrap = parameters.text("wrap", "repeat").lower()
        if wrap not in WRAPS:
            parameters.fail("wrap", f"is unknown; {did_you_mean(wrap, WRAPS)}")
        if wrap == "black":
            self._contents.lose("textures with a black border: their edge in its place", printable(name))
        return self._mapped(image, parameters, WRAPS[wrap])

    def _scale(self, parameters: Parameters, value: str) -> Value:
        """A product; of two textures of one type in pbrt-v3 and older."""
        if "tex1" in parameters or "tex2" in parameters:
            first, second = (self._part(parameters, key, value, 1.0) for key in ("tex1", "tex2"))
            return self.combined(first, second, np.multiply)
        return self.combined(self._part(parameters, "tex", value, 1.0), self.scalar(parameters, "scale", 1.0), np.multiply)

    def _mix(self, parameters: Parameters, value: str) -> Value:
        first, second = (self._part(parameters, key, value, default) for key, default in (("tex1", 0.0), ("tex2", 1.0)))
        amount = self.scalar(parameters, "amount", 0.5).map(lambda texels: texels.clip(0.0, 1.0))
        one = self.combined(first, amount, lambda texels, share: texels * (1.0 - share))
        return self.combined(one, self.combined(second, amount, np.multiply), np.add)

    def _checkerboard(self, parameters: Parameters, value: str) -> Value:
        first, second = (self._part(parameters, key, value, default) for key, default in (("tex1", 1.0), ("tex2", 0.0)))
        if int(parameters.number("dimension", 2)) != 2 or not (first.constant and second.constant):
            self._contents.lose("checkerboards in space or of images: their mean in their place", parameters.place.short)
            return Value((first.image.mean(axis=(0, 1)) + second.image.mean(axis=(0, 1))).reshape(1, 1, -1) / 2.0)
        mapped = self._mapped(checks(second.image, first.image), parameters, "repeat")
        su, _, du, _, sv, dv = mapped.transform
        # The image holds two checks along each side: t of pbrt is at 1 - t / 2 of its height, in place of 1 - t.
        return replace(mapped, transform=(0.5 * su, 0.0, 0.5 * du, 0.0, 0.5 * sv, 0.5 + 0.5 * dv))

    def combined(self, first: Value, second: Value, function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Value:
        """A function of two values, texel by texel. Images of other sizes take the nearest texels."""
        placed = second if first.constant else first
        if not first.constant and not second.constant and (first.wrap, first.transform) != (second.wrap, second.transform):
            self._contents.lose("products and mixtures of textures with other mappings: the mean of one", placed.wrap)
            second = Value(second.image.mean(axis=(0, 1), keepdims=True))
        height, width = (max(first.image.shape[axis], second.image.shape[axis]) for axis in (0, 1))
        if height * width > first.image.shape[0] * first.image.shape[1] + second.image.shape[0] * second.image.shape[1]:
            raise BokehguideError(
                f"{self._folder}: textures of {width}x{height} pixels from smaller ones; give images of one size"
            )
        images = [_resized(each.image, height, width) for each in (first, second)]
        if not (first.constant and second.constant):
            images = [np.asarray(each, np.float32) for each in images]
        return replace(placed, image=function(*images))


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """The nearest texels; an image of one texel stays as it is."""
    return image if image.shape[:2] == (1, 1) else nearest_texels(image, height, width)


MAKERS: dict[str, Callable[[Textures, Parameters, str], Value]] = {
    "constant": Textures._constant,
    "imagemap": Textures._imagemap,
    "scale": Textures._scale,
    "mix": Textures._mix,
    "checkerboard": Textures._checkerboard,
}
"""Textures that have a counterpart."""
