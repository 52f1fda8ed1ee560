"""Files of image nodes as images: UsdUVTexture, and the images of MaterialX."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.limits import most_values
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import FLOATS, decode_texture, float_texture
from bokehguide.scene.types import Texture
from bokehguide.scene.usd.coordinates import Affine, read_coordinates
from bokehguide.scene.usd.libraries import Ar, Sdf
from bokehguide.scene.usd.networks import Constants, valued
from bokehguide.scene.usd.stage import Stage

WRAPS = {"repeat": "repeat", "mirror": "mirror", "clamp": "clamp", "periodic": "repeat"}
BLACK = ("black", "constant")
"""Addressing that the node's default fills."""
DERIVED = 4
"""Values of images that are made of others, relative to the bound of the images of files."""
CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}


@dataclass(frozen=True)
class Source:
    """An image that feeds an input. image: linear float32 `[H, W, 3 or 4]` with the node's scale and bias. channel: the first
    one that the input takes. uv_name: the primvar. wrap, transform: as those of `Texture`."""

    image: np.ndarray
    channel: int
    uv_name: str
    wrap: tuple[str, str]
    transform: Affine

    @property
    def coordinates(self) -> tuple[str, tuple[str, str], Affine]:
        """The primvar, the addressing and the transform."""
        return self.uv_name, self.wrap, self.transform

    def grey(self) -> np.ndarray:
        """The values `[H, W]` of an input that takes one number."""
        return self.image[..., self.channel] if self.channel < self.image.shape[2] else np.ones(self.image.shape[:2], np.float32)

    def rgb(self) -> np.ndarray:
        """The values `[H, W, 3]` of an input that takes a colour."""
        whole = self.channel == 0 and self.image.shape[2] >= 3
        return self.image[..., :3] if whole else np.repeat(self.grey()[..., None], 3, axis=2)

    def texture(self, image: np.ndarray, uv_names: list[str]) -> Texture:
        """A texture of `image`, addressed as this source. uv_names: primvars of the material, which gain that of the source."""
        if self.uv_name not in uv_names:
            uv_names.append(self.uv_name)
        return Texture(np.ascontiguousarray(image), uv_names.index(self.uv_name), self.wrap, self.transform)


class Textures:
    """The textures of a stage. Each file is read once."""

    def __init__(self, opened: Stage):
        self._opened = opened
        self._bytes: dict[str, bytes | None] = {}
        self._scaled: dict[tuple[int, tuple[float, ...], bool], np.ndarray] = {}
        self._colors: dict[tuple[int, int], np.ndarray] = {}
        self._kept: list[np.ndarray] = []
        """Images whose identity is a key."""
        self._derived = self.count = 0

    def read(self, shader: Any, output: str, normal: bool = False) -> Source | None:
        """The image of the output "rgb", "r", "g", "b" or "a" of a UsdUVTexture shader; None, with a note, without a file.

        normal: the texels are directions between -1 and 1, and become directions mapped to [0, 1].
        """
        given = Constants(self._opened, shader)
        space = str(given.value("sourceColorSpace", "auto"))
        source = self.image(
            shader, lambda data: space == "sRGB" or (space == "auto" and not normal and is_srgb(data)), ("st", "wrapS", "wrapT")
        )
        if source is None:
            return None
        return replace(source, image=self._scale(given, source.image, normal), channel=CHANNELS.get(output, 0))

    def image(self, node: Any, srgb: Callable[[bytes], bool], inputs: tuple[str, str, str]) -> Source | None:
        """The image of the input "file" of a node; None, with a note, without a file.

        srgb: whether the bytes of a file are decoded from sRGB. inputs: names of the coordinates and of the addressing.
        """
        opened, attribute = self._opened, valued(node, "file")
        data = None if attribute is None else self.data(attribute)
        if attribute is None or data is None:
            return None
        name, place = str(attribute.Get(opened.time).path), opened.place(node.GetPrim())
        image = decode(data, name, place, opened.files, srgb(data), alpha=True)
        self.count += 1
        uv_name, transform = read_coordinates(opened, node, inputs[0])
        return Source(image, 0, uv_name, (self._wrap(node, inputs[1]), self._wrap(node, inputs[2])), transform)

    def data(self, attribute: Any) -> bytes | None:
        """The bytes of the file that an attribute names; None, with a note, without one.

        Raises BokehguideError for a file outside the scene's folder.
        """
        opened = self._opened
        value, place = attribute.Get(opened.time), opened.place(attribute)
        if value is None or not value.path:
            return None
        name = value.path
        if "<UDIM>" in name:
            opened.lose("UDIM textures: the tile 1001 is used for all", name)
            name = name.replace("<UDIM>", "1001")
        stack = attribute.GetPropertyStack(opened.time)
        absolute = Sdf.ComputeAssetPathRelativeToLayer(stack[0].layer, name) if stack else name
        if absolute not in self._bytes:
            outer = Ar.SplitPackageRelativePathOuter(absolute)[0]
            path = opened.files.find(opened.path.parent, outer, place)
            found = None
            if path.is_file():
                asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(absolute if Path(outer).is_absolute() else str(path)))
                found = bytes(asset.GetBuffer()) if asset else None
            if found is None:
                opened.lose("missing textures: left out", name.removeprefix(f"{opened.path.resolve().parent}/"))
            self._bytes[absolute] = found
        return self._bytes[absolute]

    def colors(self, source: Source) -> np.ndarray:
        """The colours `[H, W, 3]` of a source between 0 and 1, made once for each image and channel."""
        key = (id(source.image), source.channel)
        if key not in self._colors:
            self.reserve(source.image.size)
            self._colors[key] = np.ascontiguousarray(source.rgb().clip(0.0, 1.0))
            self._kept.append(source.image)
        return self._colors[key]

    def reserve(self, values: int) -> None:
        """Count the values of an image that is made of others. Raises BokehguideError for far more than the files hold."""
        self._derived += values
        if self._derived > DERIVED * most_values(self._opened.files.used[2]):
            problem = f"materials make {self._derived:,} values of images; share textures between materials"
            raise BokehguideError(f"{self._opened.path}: {problem}")

    def _scale(self, given: Constants, image: np.ndarray, normal: bool) -> np.ndarray:
        """`image` times the node's scale, plus its bias; normals mapped from [-1, 1] to [0, 1]."""
        scale = np.asarray(given.value("scale", (1.0, 1.0, 1.0, 1.0)), np.float32)
        bias = np.asarray(given.value("bias", (0.0, 0.0, 0.0, 0.0)), np.float32)
        if normal:
            scale, bias = scale / 2.0, (bias + 1.0) / 2.0
        channels = slice(0, 3 if normal else image.shape[2])
        scale, bias = scale[channels], bias[channels]
        if (scale == 1.0).all() and (bias == 0.0).all():
            return image[..., channels]
        key = (id(image), (*scale.tolist(), *bias.tolist()), normal)
        if key not in self._scaled:
            self.reserve(image.size)
            with np.errstate(over="ignore", invalid="ignore"):
                self._scaled[key] = np.nan_to_num(image[..., channels] * scale + bias, posinf=0.0, neginf=0.0)
            self._kept.append(image)
        return self._scaled[key]

    def _wrap(self, shader: Any, name: str) -> str:
        """The addressing outside [0, 1]."""
        mode = str(Constants(self._opened, shader).value(name, "useMetadata"))
        if mode in BLACK:
            self._opened.lose("textures that are black outside of [0, 1]: their border is repeated", str(shader.GetPath()))
            return "clamp"
        return WRAPS.get(mode, "repeat")


def decode(data: bytes, name: str, place: str, files: SceneFiles, srgb: bool, alpha: bool) -> np.ndarray:
    """The texels of a file, linear float32 `[H, W, 3 or 4]`. Raises BokehguideError for an unreadable image.

    name: tells the format. place: for errors. srgb: whether integers are decoded from sRGB. alpha: whether to keep the alpha.
    """
    kind = PurePosixPath(name.rstrip("]")).suffix.lower()
    if kind in FLOATS:
        return files.image(data, srgb, alpha, lambda: _floats(data, kind, place, files))
    return decode_texture(data, place, files, srgb, alpha)


def _floats(data: bytes, kind: str, place: str, files: SceneFiles) -> np.ndarray:
    """An image of linear floats, `[H, W, 3]`. kind: ".exr" or ".hdr"."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"image{kind}"
        path.write_bytes(data)
        try:
            return float_texture(path, files, str(path))
        except BokehguideError as error:
            raise BokehguideError(f"{place}: {str(error).replace(str(path), 'the image')}") from None


def is_srgb(data: bytes) -> bool:
    """Whether a texture of the colour space "auto" is encoded in sRGB: with 8 bits and three or four channels."""
    from PIL import Image

    try:
        with Image.open(BytesIO(data)) as image:
            deep = image.format == "PNG" and data[24:25] == b"\x10"
            return image.mode not in ("1", "L", "LA", "F") and not image.mode.startswith("I") and not deep
    except Exception:  # no image that Pillow knows; the decoder tells what is wrong
        return False
