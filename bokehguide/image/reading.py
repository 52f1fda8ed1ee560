"""EXR and HDR files, read by OpenImageIO, which returns its errors and does not print them."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.limits import MAX_PIXELS, MAX_SIDE, most_map_values
from bokehguide.memory import require_memory

MAGIC = {"EXR": b"\x76\x2f\x31\x01", "HDR": b"#?"}


@dataclass(frozen=True)
class Channels:
    """The first part of a file. names: of the channels; pixels: float32 `[H, W, C]`; header: attributes by name."""

    names: tuple[str, ...]
    pixels: np.ndarray
    header: dict[str, Any]


def read_channels(path: str | Path, kind: str = "EXR") -> Channels:
    """The first part of a file of the `kind` "EXR" or "HDR".

    Raises BokehguideError for a file that is missing, damaged, too large or of another kind.
    """
    try:
        mode = Path(path).stat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # opening a pipe could block for ever
            raise BokehguideError(f"{path}: is no regular file; give an {kind} file")
        with Path(path).open("rb") as file:
            start = file.read(len(MAGIC[kind]))
    except OSError as error:
        raise BokehguideError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if start != MAGIC[kind]:
        raise BokehguideError(f"{path}: is not an {kind} file; give an {kind} file")
    try:
        return _read(path)
    except UnicodeDecodeError:  # from names in the file, and from reports of OpenImageIO
        raise _damaged(path, "names that are no UTF-8") from None


def read_crop(path: str | Path) -> tuple[int, int, int, int, int, int] | None:
    """The data window of an intact file in its display window: x, y, width, height, and width and height of the display window.

    None if both windows are the same, so that the file shows a whole frame.
    """
    import OpenImageIO as oiio

    image = oiio.ImageInput.open(str(path))
    assert image is not None, "intact"
    spec = image.spec()
    x, y, frame = spec.x - spec.full_x, spec.y - spec.full_y, (spec.full_width, spec.full_height)
    return None if (x, y, spec.width, spec.height) == (0, 0, *frame) else (x, y, spec.width, spec.height, *frame)


def _read(path: str | Path) -> Channels:
    import OpenImageIO as oiio

    image = oiio.ImageInput.open(str(path))
    if image is None:
        raise _damaged(path, oiio.geterror())
    spec, stored = image.spec(), Path(path).stat().st_size
    if not (0 < spec.width <= MAX_SIDE and 0 < spec.height <= MAX_SIDE and spec.width * spec.height <= MAX_PIXELS):
        raise BokehguideError(f"{path}: {spec.width}x{spec.height} pixels are too many; give at most {MAX_PIXELS}")
    values = spec.width * spec.height * spec.nchannels
    if values > most_map_values(stored):
        raise BokehguideError(f"{path}: would unfold from {stored:,} bytes to {values:,} values; give a smaller image")
    require_memory(4 * values, str(path), "smaller image")
    pixels = image.read_image(oiio.FLOAT)
    if pixels is None:
        raise _damaged(path, image.geterror())
    header = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    return Channels(tuple(spec.channelnames), pixels.reshape(spec.height, spec.width, -1), header)


def _damaged(path: str | Path, report: str) -> BokehguideError:
    reason = printable(report.partition("\n")[0].removeprefix(f"EXR Error ({path}): "), 200) or "unknown reason"
    return BokehguideError(f"{path}: is damaged ({reason}); give an intact copy")
