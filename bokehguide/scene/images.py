"""Environment maps and textures: files into linear float32 arrays."""

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

from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.limits import LARGEST
from bokehguide.scene.files import SceneFiles, require_file

if TYPE_CHECKING:
    from PIL import Image

    from bokehguide.image.reading import Channels

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")
"""Of textures. Pillow knows more, and runs other programs for some."""


def load_environment_map(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read an equirectangular `.hdr` or `.exr` map, float32 `[H, W, 3]`, and any warnings.

    Raises BokehguideError for a missing or unreadable file and for NaN, infinite or
    huge texels. Negative texels become 0, with a warning.
    """
    from bokehguide.image.reading import read_channels  # brings torch, which a colour does without

    kind = path.suffix.upper().removeprefix(".")
    if kind not in ("HDR", "EXR"):
        raise BokehguideError(f"{path}: not an environment map; give a .hdr or .exr file")
    require_file(path, "environment map")
    radiance = _radiance(read_channels(path, kind), path)
    bad = np.count_nonzero(~(np.abs(radiance) <= LARGEST).all(axis=2))
    if bad:
        raise BokehguideError(f"{path}: {bad} texels are NaN or infinite, or beyond {LARGEST:g}; repair the map")
    negative = np.count_nonzero((radiance < 0.0).any(axis=2))
    found = [f"{path.name}: {negative} negative texels were set to 0"] if negative else []
    return np.maximum(radiance, 0.0), found


def _radiance(read: Channels, path: Path) -> np.ndarray:
    """Colours, or a grey channel three times."""
    for names in ("RGB", "YYY"):
        if set(names) <= set(read.names):
            return np.stack([read.pixels[..., read.names.index(name)] for name in names], axis=-1)
    given = printable(", ".join(read.names), 200)
    raise BokehguideError(f"{path}: has the channels {given}; an environment map needs R, G, B")


def load_texture(path: Path, files: SceneFiles, srgb: bool, alpha: bool = False) -> np.ndarray:
    """Read an image as `decode_texture` does. Raises BokehguideError for a missing or unreadable file."""
    require_file(path, "texture")
    return decode_texture(path.read_bytes(), str(path), files, srgb, alpha)


def decode_texture(data: bytes, place: str, files: SceneFiles, srgb: bool, alpha: bool = False) -> np.ndarray:
    """An image file as linear float32 `[H, W, 3]`, or `[H, W, 4]` where `alpha` is asked for and there.

    files: the scene's, which count how much is unfolded. srgb: the colours are encoded. PNGs
    keep their 16 bits. Raises BokehguideError, naming `place`, for an image that cannot be
    read or is too large.
    """
    from PIL import Image

    with _decoding(place):
        image = Image.open(BytesIO(data), formats=FORMATS)
    files.unfold(4 * image.width * image.height, len(data), place)
    with _decoding(place):
        deep = image.format == "PNG" and data[24:25] == b"\x10"
        texels = _sixteen_bits(data) if deep else _eight_bits(image, alpha)
    return _linear(texels, srgb, alpha)


def texture_from_image(image: Image.Image, place: str, files: SceneFiles) -> np.ndarray:
    """The sRGB colours of an opened Pillow image as `decode_texture` gives them."""
    if image.format not in FORMATS:
        raise BokehguideError(f"{place}: a texture in the format {image.format}; give a PNG, a JPEG or a WebP")
    files.unfold(4 * image.width * image.height, 0, place)
    with _decoding(place):
        texels = _eight_bits(image, alpha=False)
    return _linear(texels, srgb=True, alpha=False)


@contextmanager
def _decoding(place: str) -> Iterator[None]:
    """Whatever a decoder raises, as a BokehguideError that names `place`."""
    from PIL import UnidentifiedImageError

    try:
        with warnings.catch_warnings(), _silent():
            warnings.simplefilter("ignore")  # of oddities, and of sizes, for which SceneFiles has the bound
            yield
    except UnidentifiedImageError:
        raise BokehguideError(f"{place}: unreadable texture; give a PNG, a JPEG or a WebP") from None
    except Exception as error:  # what the decoders raise for damaged data is not in their documentation
        raise BokehguideError(f"{place}: unreadable texture ({reason(error)})") from None


@contextmanager
def _silent() -> Iterator[None]:
    """Without what libpng and libtiff print, in C, about a file: the exceptions say it too."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _eight_bits(image: Image.Image, alpha: bool) -> np.ndarray:
    """uint8 `[H, W, 3 or 4]`."""
    return np.asarray(image.convert("RGBA" if alpha and image.has_transparency_data else "RGB"))


def _sixteen_bits(data: bytes) -> np.ndarray:
    """A PNG of 16 bits as uint16 `[H, W, 3 or 4]`; Pillow would leave 8 of them."""
    import OpenImageIO as oiio

    with NamedTemporaryFile(suffix=".png") as file:  # OpenImageIO's Python reads no memory
        file.write(data)
        file.flush()
        wishes = oiio.ImageSpec()
        wishes.attribute("oiio:UnassociatedAlpha", 1)
        source = oiio.ImageInput.open(file.name, wishes)
        pixels = source.read_image(oiio.UINT16) if source is not None else None
        if pixels is None:
            raise ValueError(oiio.geterror() if source is None else source.geterror())
    grey, channels = pixels.shape[2] < 3, pixels.shape[2]
    return pixels[..., [0, 0, 0, 1][: channels + 2]] if grey else pixels


def _linear(texels: np.ndarray, srgb: bool, alpha: bool) -> np.ndarray:
    """uint8 or uint16 `[H, W, 3 or 4]` as linear float32; the fourth channel is never encoded."""
    levels = np.linspace(0.0, 1.0, np.iinfo(texels.dtype).max + 1, dtype=np.float32)
    linear = (srgb_to_linear(levels) if srgb else levels)[texels if alpha else texels[..., :3]]
    if linear.shape[2] == 4:
        linear[..., 3] = levels[texels[..., 3]]
    return linear


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Undo the sRGB curve (IEC 61966-2-1), float32."""
    low = encoded / 12.92
    high = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)
