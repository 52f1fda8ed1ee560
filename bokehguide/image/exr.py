"""EXR files of one part with one float channel per name, which every compositor reads."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from bokehguide.errors import BokehguideError, printable
from bokehguide.image import cryptomatte
from bokehguide.image.files import replacing, unwritable
from bokehguide.image.reading import read_channels

GROUP_LAYER = "Combined_"
"""Prefix of the layers of light groups, as in the files of Blender."""
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities x, y of red, green, blue and white."""
HALF_MAX = float(np.finfo(np.float16).max)

# Alpha is associated, as EXR defines it: the beauty is multiplied by alpha. R, G, B and A without a layer are "Combined" in
# Blender and "rgba" in Nuke. layer.channel is a pass in Blender and a layer in Nuke, whose depth layer has the name `depth.Z`.
CHANNELS = {
    "beauty": ("R", "G", "B"),
    "alpha": ("A",),
    "denoised": ("denoised.R", "denoised.G", "denoised.B"),
    "depth": ("depth.Z",),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "emission": ("emission.R", "emission.G", "emission.B"),
    "variance": ("variance.Y",),
    "sample_count": ("samples.Y",),
    **cryptomatte.CHANNELS,
}


def write_exr(
    path: str | Path,
    layers: Mapping[str, np.ndarray] | Iterator[tuple[str, np.ndarray]],
    metadata: Mapping[str, str | int | float] | None = None,
    half: bool = False,
    corner: tuple[int, int] = (0, 0),
    frame: tuple[int, int] | None = None,
) -> None:
    """Write layers in 32-bit float or, with `half`, in 16-bit float. The file appears only when it is complete.

    layers: by the keys of `CHANNELS`, `[H, W]` for one channel, `[H, W, C]` for C, and those of `group_layers`, as a mapping or
    as pairs of name and layer (see `drained`); metadata: header attributes, except for names that OpenEXR reserves, such as
    `version`, `type` and `view`; corner, frame: position (column, row) of the layers in a larger frame and its (width, height),
    which become data window and display window.

    Raises BokehguideError if the folder cannot be written, for an unknown layer and for none, or if a value exceeds the range of
    `half`.
    """
    channels = {}
    for layer, pixels in layers.items() if isinstance(layers, Mapping) else layers:
        for index, name in enumerate(_channels(path, layer)):
            plane = pixels if pixels.ndim == 2 else pixels[..., index]
            channels[name] = _plane(path, name, plane, np.float16 if half else np.float32)
    if not channels:
        raise BokehguideError(f"{path}: no layer is given; give at least one, such as beauty")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {"chromaticities": REC709, "colorInteropID": "lin_rec709_scene"}
    height, width = next(iter(channels.values())).shape
    header |= {"dataWindow": _window(corner, (width, height)), "displayWindow": _window((0, 0), frame or (width, height))}
    with replacing(path) as temporary:
        try:
            OpenEXR.File(header | dict(metadata or {}), channels).write(str(temporary))
        except RuntimeError as error:
            raise unwritable(Path(path), error) from error


def drained(layers: dict[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    """Layers `[H, W]` or `[H, W, C]` for `write_exr`, with their names, taken out of the dictionary one by one.

    The memory of each layer is free once the layer is split into channels.
    """
    while layers:
        name = next(iter(layers))
        yield name, layers.pop(name)


def group_layers(groups: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Layers for `write_exr` of light groups `[H, W, 3]` by name."""
    return {GROUP_LAYER + name: radiance for name, radiance in groups.items()}


def _channels(path: str | Path, layer: str) -> tuple[str, ...]:
    """The names of the channels of a layer. Raises BokehguideError, naming `path`, for an unknown layer."""
    if layer in CHANNELS:
        return CHANNELS[layer]
    if not str(layer).startswith(GROUP_LAYER):
        known = ", ".join(name for name in CHANNELS if name not in cryptomatte.CHANNELS)
        raise BokehguideError(f"{path}: {printable(str(layer))} is no layer; give {known}, a matte or {GROUP_LAYER}NAME")
    return tuple(f"{layer}.{channel}" for channel in "RGB")


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """All channels of a file's first part by name (`R`, `depth.Z`, ...), float32 `[H, W]`.

    Raises BokehguideError for a file that is missing, damaged or no EXR.
    """
    read = read_channels(path)
    return {name: read.pixels[..., index] for index, name in enumerate(read.names)}


def read_layers(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The complete layers of a file by the names that `write_exr` takes, `[H, W]` or `[H, W, C]`, and its header.

    Raises as `read_exr`.
    """
    read = read_channels(path)
    planes = {name: read.pixels[..., index] for index, name in enumerate(read.names)}
    layers = {}
    groups = (name.removesuffix(".R") for name in planes if name.startswith(GROUP_LAYER) and name.endswith(".R"))
    for layer, names in (CHANNELS | {group: _channels(path, group) for group in groups}).items():
        if all(name in planes for name in names):
            layers[layer] = planes[names[0]] if len(names) == 1 else np.stack([planes[name] for name in names], axis=-1)
    return layers, read.header


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The header attributes of a file, including those of `write_exr`. Raises as `read_exr`."""
    return read_channels(path).header


def read_rgb(path: str | Path) -> np.ndarray:
    """The channels R, G and B, float32 `[H, W, 3]`. Raises as `read_exr`, and for a missing channel."""
    channels = read_exr(path)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise BokehguideError(
            f"{path}: no channel {', '.join(missing)} among {printable(', '.join(sorted(channels)), 200)}; "
            "give an EXR with R, G and B"
        )
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def _window(corner: tuple[int, int], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """First and last pixel (column, row) of a window, the form of OpenEXR."""
    first = np.array(corner, np.int32)
    return first, first + np.array(size, np.int32) - 1


def _plane(path: str | Path, name: str, plane: np.ndarray, dtype: type) -> np.ndarray:
    """The pixels of a channel in contiguous memory. Raises BokehguideError for a value above the range of half floats."""
    if dtype is np.float16 and np.abs(plane, where=np.isfinite(plane), out=np.zeros_like(plane)).max() > HALF_MAX:
        raise BokehguideError(f"{path}: {name} exceeds {HALF_MAX:.0f}, the largest half float; write 32-bit floats")
    # OpenEXR silently writes wrong pixels of a strided view.
    return np.ascontiguousarray(plane, dtype=dtype)
