"""Textures: image files as linear float32 arrays."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING

import numpy as np

from bokehguide.color import srgb_to_linear
from bokehguide.errors import BokehguideError, reason
from bokehguide.image.reading import read_channels
from bokehguide.limits import LARGEST
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.ktx2 import Ktx2, is_ktx2

if TYPE_CHECKING:
    from PIL import Image

FORMATS = ("PNG", "JPEG", "WEBP", "AVIF", "BMP", "TGA", "TIFF")
"""File formats of textures that Pillow decodes, beside KTX 2. Pillow knows more, some of them with external programs."""
BITS_PER_SAMPLE = 258
"""Tag of TIFF files."""
CHECK_TEXELS = 64
"""Texels along the side of a check: textures are sampled bilinearly, so that a check ends within one texel."""
FLOATS = (".exr", ".hdr")
"""Suffixes of images of floats, which `float_texture` reads."""
REMEDY = "give a PNG, a JPEG or a WebP; BMP, TGA, and TIFF of 8 or 16 bits are read too"


def load_texture(path: Path, files: SceneFiles, srgb: bool, alpha: bool = False) -> np.ndarray:
    """Read an image file as `decode_texture` does. Raises BokehguideError for a missing or unreadable file."""
    require_file(path, "texture")
    return decode_texture(path.read_bytes(), str(path), files, srgb, alpha)


def float_texture(path: Path, files: SceneFiles, place: str) -> np.ndarray:
    """The pixels of an `.exr` or `.hdr` file, linear float32 `[H, W, 3]`; the first channel three times without R, G and B.

    files: reserves the memory of the image. Texels that are not finite become 0. Raises BokehguideError for
    an unreadable file, and, naming `place`, for a too large one.
    """
    read = read_channels(path, path.suffix.upper().removeprefix("."))
    names = "RGB" if set("RGB") <= set(read.names) else (read.names[0],) * 3
    image = np.stack([read.pixels[..., read.names.index(name)] for name in names], axis=-1)
    files.reserve(image.size, path.stat().st_size, place)
    return np.nan_to_num(image, posinf=0.0, neginf=0.0).clip(-LARGEST, LARGEST)


def decode_texture(data: bytes, place: str, files: SceneFiles, srgb: bool, alpha: bool = False) -> np.ndarray:
    """The pixels of an image file, linear float32 `[H, W, 3]`, or `[H, W, 4]` if `alpha` and the image has it.

    files: the scene's decoded images, with their budget. srgb: decodes the colours from sRGB. PNGs and
    grey TIFFs keep 16 bits. Raises BokehguideError, naming `place`, for an unreadable or too large image.
    """
    return files.image(data, srgb, alpha, lambda: _decode(data, place, files, srgb, alpha))


def _decode(data: bytes, place: str, files: SceneFiles, srgb: bool, alpha: bool) -> np.ndarray:
    """`decode_texture` of a new image."""
    from PIL import Image

    if is_ktx2(data):
        with _decoding(place):
            packed = Ktx2(data)
        files.reserve(4 * packed.width * packed.height, len(data), place)
        with _decoding(place):
            return _linear(packed.pixels(alpha), srgb, alpha)
    with _decoding(place):
        image = Image.open(BytesIO(data), formats=FORMATS)
    _check_mode(image, place)
    files.reserve(4 * image.width * image.height, len(data), place)
    with _decoding(place):
        deep = image.format == "PNG" and data[24:25] == b"\x10"
        texels = _deep_png(data) if deep else _texels(image, alpha)
    return _linear(texels, srgb, alpha)


def texture_from_image(image: Image.Image, place: str, files: SceneFiles) -> np.ndarray:
    """The colours of an open sRGB image, linear float32 `[H, W, 3]`. Raises as `decode_texture` does."""
    if image.format not in FORMATS:
        raise BokehguideError(f"{place}: a texture in the format {image.format}; {REMEDY}")
    _check_mode(image, place)
    files.reserve(4 * image.width * image.height, 0, place)
    with _decoding(place):
        texels = _texels(image, alpha=False)
    return _linear(texels, srgb=True, alpha=False)


def nearest_texels(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image `[H, W, ...]` in another size, `[height, width, ...]`."""
    if image.shape[:2] == (height, width):
        return image
    rows, columns = (np.arange(size) * there // size for size, there in zip((height, width), image.shape))
    return image[rows[:, None], columns]


def checks(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """An image `[H, W, C]` of two by two checks, `first` in the top left corner. first, second: colours that broadcast to it."""
    row = np.repeat([False, True], CHECK_TEXELS)
    return np.where((row[:, None] ^ row)[..., None], second, first)


@contextmanager
def _decoding(place: str) -> Iterator[None]:
    """Turn any exception of a decoder into a BokehguideError that names `place`."""
    from PIL import UnidentifiedImageError

    try:
        with warnings.catch_warnings(), _silent():
            warnings.simplefilter("ignore")  # SceneFiles bounds the size
            yield
    except UnidentifiedImageError:
        raise BokehguideError(f"{place}: unreadable texture; {REMEDY}") from None
    except Exception as error:  # the decoders do not document their exceptions for damaged data
        raise BokehguideError(f"{place}: unreadable texture ({reason(error)})") from None


@contextmanager
def _silent() -> Iterator[None]:
    """Suppress the messages that libpng and libtiff print from C; their exceptions say the same."""
    if sys.stderr is None:  # closed by the caller
        yield
        return
    sys.stderr.flush()
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def _check_mode(image: Image.Image, place: str) -> None:
    """Raise BokehguideError for pixels of which Pillow loses the scale."""
    if 12 in getattr(image, "tag_v2", {}).get(BITS_PER_SAMPLE, ()):
        raise BokehguideError(f"{place}: a texture of 12 bits; {REMEDY}")
    if image.mode in ("F", "I"):
        raise BokehguideError(f"{place}: a texture of floats, or of signed or 32-bit whole numbers; {REMEDY}")


def _texels(image: Image.Image, alpha: bool) -> np.ndarray:
    """The pixels of an open image, uint8 `[H, W, 3 or 4]`, or uint16 for 16-bit greys."""
    if image.mode.startswith("I;16"):
        return np.repeat(np.asarray(image).astype(np.uint16)[..., None], 3, axis=2)
    return np.asarray(image.convert("RGBA" if alpha and image.has_transparency_data else "RGB"))


def _deep_png(data: bytes) -> np.ndarray:
    """The pixels of a 16-bit PNG, uint16 `[H, W, 3 or 4]`. Pillow would reduce them to 8 bits."""
    import OpenImageIO as oiio

    with NamedTemporaryFile(suffix=".png") as file:  # OpenImageIO's Python API reads files only
        file.write(data)
        file.flush()
        config = oiio.ImageSpec()
        config.attribute("oiio:UnassociatedAlpha", 1)
        source = oiio.ImageInput.open(file.name, config)
        pixels = source.read_image(oiio.UINT16) if source is not None else None
        if pixels is None:
            raise ValueError(oiio.geterror() if source is None else source.geterror())
    grey, channels = pixels.shape[2] < 3, pixels.shape[2]
    return pixels[..., [0, 0, 0, 1][: channels + 2]] if grey else pixels


def _linear(texels: np.ndarray, srgb: bool, alpha: bool) -> np.ndarray:
    """uint8 or uint16 `[H, W, 3 or 4]` as linear float32. Alpha is always linear."""
    levels = np.linspace(0.0, 1.0, np.iinfo(texels.dtype).max + 1, dtype=np.float32)
    linear = (srgb_to_linear(levels) if srgb else levels)[texels if alpha else texels[..., :3]]
    if linear.shape[2] == 4:
        linear[..., 3] = levels[texels[..., 3]]
    return linear
