"""Environment maps and textures: files into linear float32 arrays `[H, W, 3]`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError


def load_environment_map(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read an equirectangular `.hdr` or `.exr` map, float32 `[H, W, 3]`, and any warnings.

    Raises BokehguideError for a missing or unreadable file and for NaN or infinite
    texels. Negative texels become 0, with a warning.
    """
    readers = {".hdr": _read_hdr, ".exr": _read_exr}
    if path.suffix.lower() not in readers:
        raise BokehguideError(f"{path}: not an environment map; give a .hdr or .exr file")
    require_file(path, "environment map")
    radiance = readers[path.suffix.lower()](path)
    if not np.isfinite(radiance).all():
        bad = np.count_nonzero(~np.isfinite(radiance).all(axis=2))
        raise BokehguideError(f"{path}: {bad} texels are NaN or infinite; repair the map")
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


def _read_hdr(path: Path) -> np.ndarray:
    import OpenImageIO as oiio

    image = oiio.ImageInput.open(str(path))
    pixels = image.read_image(oiio.FLOAT) if image else None
    if pixels is None:
        reason = (image.geterror() if image else oiio.geterror()) or "unknown format"
        raise BokehguideError(f"{path}: unreadable HDR map ({reason.splitlines()[0]})")
    return _three_channels(pixels, path)


def _read_exr(path: Path) -> np.ndarray:
    import OpenEXR

    try:
        with OpenEXR.File(str(path)) as file:
            channels = {name: np.array(c.pixels) for name, c in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else "damaged"
        raise BokehguideError(f"{path}: unreadable EXR map ({reason})") from None
    for name in ("RGB", "RGBA", "Y"):
        if name in channels:
            return _three_channels(channels[name], path)
    if {"R", "G", "B"} <= channels.keys():
        return _three_channels(np.stack([channels[name] for name in "RGB"], axis=-1), path)
    names = ", ".join(sorted(channels))
    raise BokehguideError(f"{path}: has the channels {names}; an environment map needs R, G, B")


def _three_channels(pixels: np.ndarray, path: Path) -> np.ndarray:
    pixels = np.asarray(pixels, dtype=np.float32)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    if pixels.size == 0:
        raise BokehguideError(f"{path}: the map has no texels")
    rgb = pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    return np.ascontiguousarray(rgb)


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
