"""PNG files. Needs no Blender."""

from __future__ import annotations

import struct
import zlib

import numpy as np


def png(colors: np.ndarray) -> bytes:
    """A PNG file of uint8 `[H, W, 3]`, top row first. Source: Portable Network Graphics Specification, third edition."""
    height, width, _ = colors.shape
    rows = np.concatenate((np.zeros((height, 1), np.uint8), colors.reshape(height, -1)), axis=1)  # no filter
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 1)), (b"IEND", b""))
    chunks = (struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
