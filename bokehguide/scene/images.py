"""Environment maps and textures: files into linear float32 arrays `[H, W, 3]`."""

from __future__ import annotations

from pathlib import Path
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


def load_texture(path: Path, srgb: bool) -> np.ndarray:
    """Read an 8-bit image, linear float32 `[H, W, 3]`; `srgb` says that it is encoded.

    Raises BokehguideError for a missing or unreadable file.
    """
    from PIL import Image, UnidentifiedImageError

    require_file(path, "texture")
    try:
        with Image.open(path) as image:
            return texture_from_image(image, srgb)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
        raise BokehguideError(f"{path}: unreadable texture ({error})") from None


def texture_from_image(image, srgb: bool) -> np.ndarray:
    """A Pillow image as linear float32 `[H, W, 3]`."""
    encoded = np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)
    return srgb_to_linear(encoded) if srgb else encoded


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Undo the sRGB curve (IEC 61966-2-1), float32."""
    low = encoded / 12.92
    high = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)
