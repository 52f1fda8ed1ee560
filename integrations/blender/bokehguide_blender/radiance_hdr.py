"""Radiance HDR files. Needs no Blender."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_hdr(path: Path, colors: np.ndarray) -> None:
    """Write linear colours `[H, W, 3]`, top row first. The error is 0.4 % of the largest channel of a pixel."""
    height, width, _ = colors.shape
    peak = np.maximum(colors.max(axis=2), 1e-30)
    exponent = np.floor(np.log2(peak)).astype(np.int32) + 1
    mantissa = np.clip(colors * np.exp2(8.0 - exponent)[..., None] + 0.5, 0.0, 255.0).astype(np.uint8)
    texels = np.concatenate((mantissa, np.clip(exponent + 128, 0, 255).astype(np.uint8)[..., None]), axis=2)
    texels[colors.max(axis=2) <= 0.0] = 0
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    path.write_bytes(header.encode() + texels.tobytes())
