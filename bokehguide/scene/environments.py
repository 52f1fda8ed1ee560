"""Environment maps: read from files, of one colour, or with a vertical gradient."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.image.reading import Channels, read_channels
from bokehguide.limits import LARGEST
from bokehguide.scene.files import require_map
from bokehguide.scene.types import Environment


def load_environment_map(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read an equirectangular `.hdr` or `.exr` map: radiance, float32 `[H, W, 3]`, and warnings.

    Raises BokehguideError for a missing or unreadable file and for NaN, infinite or
    huge texels. Negative texels become 0, with a warning.
    """
    require_map(path)
    radiance = _radiance(read_channels(path, path.suffix.upper().removeprefix(".")), path)
    bad = np.any(~(np.abs(radiance) <= LARGEST), axis=2)
    if bad.any():
        raise BokehguideError(f"{path}: texels that are NaN, infinite or beyond {LARGEST:g}: {_counted(bad)}; repair the map")
    negative = np.any(radiance < 0.0, axis=2)
    warnings = [f"{path.name}: negative texels, set to 0: {_counted(negative)}"] if negative.any() else []
    return np.maximum(radiance, 0.0), warnings


def _counted(texels: np.ndarray) -> str:
    """The number of the texels in a mask `[H, W]`, and the place of the first one."""
    row, column = np.unravel_index(int(texels.argmax()), texels.shape)
    return f"{np.count_nonzero(texels)}, the first in column {column} and row {row}, counted from 0"


def _radiance(read: Channels, path: Path) -> np.ndarray:
    """The R, G and B channels, or the Y channel three times."""
    for names in ("RGB", "YYY"):
        if set(names) <= set(read.names):
            return np.stack([read.pixels[..., read.names.index(name)] for name in names], axis=-1)
    given = printable(", ".join(read.names), 200)
    raise BokehguideError(f"{path}: has the channels {given}; an environment map needs R, G, B")


def constant_radiance(color: Iterable[float]) -> np.ndarray:
    """A 1 × 1 map of one colour, float32 `[1, 1, 3]`."""
    return np.asarray(color, dtype=np.float32).reshape(1, 1, 3)


def gradient(stops: Sequence[tuple[float, Sequence[float]]], height: int = 32) -> np.ndarray:
    """A map `[height, 2 height, 3]` that interpolates `stops`: rising elevations in degrees, each with its radiance."""
    elevation = 90.0 - 180.0 * (np.arange(height) + 0.5) / height
    angles, colors = zip(*stops)
    rows = np.stack([np.interp(elevation, angles, c) for c in np.transpose(colors)], axis=1)
    return np.repeat(rows[:, None], 2 * height, axis=1).astype(np.float32)


def sky(*stops: tuple[float, Sequence[float]]) -> Environment:
    """An environment with the `gradient` of `stops`."""
    return Environment(gradient(stops))
