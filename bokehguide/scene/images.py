"""Environment maps and textures: files into linear float32 arrays."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.limits import LARGEST

if TYPE_CHECKING:
    from bokehguide.image.reading import Channels


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
    warnings = [f"{path.name}: {negative} negative texels were set to 0"] if negative else []
    return np.maximum(radiance, 0.0), warnings


def require_file(path: Path, what: str) -> None:
    """Raise BokehguideError unless `path` is a file that can be read."""
    if path.is_dir():
        raise BokehguideError(f"{path}: is a folder; give a file ({what})")
    if not path.exists():
        raise BokehguideError(f"{path}: no such file ({what}); check the path")
    try:
        path.open("rb").close()
    except OSError as error:
        raise BokehguideError(f"{path}: cannot be read ({error.strerror}); {what}") from None


def _radiance(read: Channels, path: Path) -> np.ndarray:
    """Colours, or a grey channel three times."""
    for names in ("RGB", "YYY"):
        if set(names) <= set(read.names):
            return np.stack([read.pixels[..., read.names.index(name)] for name in names], axis=-1)
    given = ", ".join(read.names)
    raise BokehguideError(f"{path}: has the channels {given}; an environment map needs R, G, B")


def load_texture(path: Path, srgb: bool, alpha: bool = False) -> np.ndarray:
    """Read an image as `decode_texture` does. Raises BokehguideError for a missing or unreadable file."""
    require_file(path, "texture")
    return decode_texture(path.read_bytes(), str(path), srgb, alpha)


def decode_texture(data: bytes, place: str, srgb: bool, alpha: bool = False) -> np.ndarray:
    """A PNG, JPEG or WebP file as linear float32 `[H, W, 3]`, or `[H, W, 4]` where `alpha` is asked for and there.

    srgb: the colours are encoded. PNGs keep their 16 bits. Raises BokehguideError,
    naming `place`, for an image that cannot be read.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        if data[:8] == b"\x89PNG\r\n\x1a\n" and data[24:25] == b"\x10":
            return _linear(_sixteen_bits(data), srgb, alpha)
        with Image.open(BytesIO(data)) as image:
            return texture_from_image(image, srgb, alpha)
    except UnidentifiedImageError:
        raise BokehguideError(f"{place}: unreadable texture; give a PNG, a JPEG or a WebP") from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise BokehguideError(f"{place}: unreadable texture ({error})") from None


def texture_from_image(image, srgb: bool, alpha: bool = False) -> np.ndarray:
    """A Pillow image as linear float32 `[H, W, 3]`, or `[H, W, 4]` where `alpha` is asked for and there."""
    mode = "RGBA" if alpha and image.has_transparency_data else "RGB"
    return _linear(np.asarray(image.convert(mode)), srgb, alpha)


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
            raise ValueError((oiio.geterror() if source is None else source.geterror()).splitlines()[0])
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
