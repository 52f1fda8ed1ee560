"""PNG images of 8 bits per channel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from bokehguide.image.files import replacing


def write_png(path: str | Path, display: Tensor) -> None:
    """Write display values `[H, W, 3]` in 0..1 as PNG.

    Raises BokehguideError if the folder cannot be written.
    """
    with replacing(path) as temporary:
        Image.fromarray(to_8_bit(display)).save(temporary, format="PNG")


def to_8_bit(display: Tensor) -> np.ndarray:
    """Display values in 0..1, rounded to the nearest of 256 levels, uint8 of the same shape."""
    return (display.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy()
