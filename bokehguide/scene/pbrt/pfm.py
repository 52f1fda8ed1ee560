"""PFM images: a text header, then floats from the bottom row to the top row."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.limits import LARGEST, MAX_SIDE
from bokehguide.scene.files import SceneFiles, require_file

HEADER = re.compile(rb"(PF|Pf)\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,20})\s")
"""Kind, width, height, and a number whose sign tells the order of the bytes."""


def read_pfm(path: Path, files: SceneFiles, place: str) -> np.ndarray:
    """An image of linear floats `[H, W, 3]`, top row first. place: where the file is named.

    Raises BokehguideError for a file that is missing, damaged, too large or has values that are not finite.
    """
    require_file(path, "image", place)
    data = path.read_bytes()
    header = HEADER.match(data[:100])
    if header is None:
        raise BokehguideError(f"{path}: is not a PFM file; give an intact one")
    width, height, channels = int(header[2]), int(header[3]), 3 if header[1] == b"PF" else 1
    count = width * height * channels
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE) or len(data) - header.end() < 4 * count:
        raise BokehguideError(f"{path}: has fewer than {width}x{height} pixels; give an intact file")
    files.reserve(count, len(data), str(path))
    order = "<f4" if header[4].startswith(b"-") else ">f4"
    values = np.frombuffer(data, order, count, header.end()).reshape(height, width, channels)
    if not (np.abs(values) <= LARGEST).all():
        raise BokehguideError(f"{path}: has values that are not finite or beyond {LARGEST:g}; repair it")
    return np.repeat(values[::-1], 3 // channels, axis=2).astype(np.float64)
