"""PNG pictures of 8 bits a channel."""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from bokehguide.image.files import replacing


def write_png(path: str | Path, display: Tensor) -> None:
    """Write display values `[H, W, 3]` in 0..1, rounded to the nearest of 256 levels.

    Raises BokehguideError where the folder cannot be written.
    """
    levels = (display.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    with replacing(path) as temporary:
        Image.fromarray(levels.cpu().numpy()).save(temporary, format="PNG")
