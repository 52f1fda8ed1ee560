"""PNG images of 8 or 16 bits per channel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from bokehguide.image.files import replacing


def write_png(path: str | Path, display: Tensor, bits: int = 8) -> None:
    """Write display values in 0..1 as PNG: `[H, W, 3]`, or `[H, W, 4]` with straight alpha. bits: per channel, 8 or 16.

    Raises BokehguideError if the folder cannot be written.
    """
    with replacing(path) as temporary:
        if bits == 16:
            _write_16_bit(temporary, display)
        else:
            Image.fromarray(to_8_bit(display)).save(temporary, format="PNG")


def to_8_bit(display: Tensor) -> np.ndarray:
    """Display values in 0..1, rounded to the nearest of 256 levels, uint8 of the same shape."""
    return (display.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy()


def _write_16_bit(path: Path, display: Tensor) -> None:
    """Write a PNG with 16 bits per channel, which Pillow cannot. Raises OSError if the file cannot be written."""
    import OpenImageIO as oiio

    levels = (display.clamp(0.0, 1.0) * 65535.0).round().cpu().numpy().astype(np.uint16)
    height, width, channels = levels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT16)
    spec["oiio:UnassociatedAlpha"] = 1  # else OpenImageIO would divide by alpha
    image = oiio.ImageOutput.create("png")
    assert image is not None, "OpenImageIO contains PNG"
    if not (image.open(str(path), spec) and image.write_image(levels) and image.close()):
        raise OSError(image.geterror())
