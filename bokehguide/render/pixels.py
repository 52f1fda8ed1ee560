"""Which pixels of a frame a batch is made of."""

from __future__ import annotations

import torch
from torch import Tensor

Pixels = slice | Tensor
"""Flat pixel indices: a slice `first:end` where they are consecutive, which makes views of a frame's
arrays, or int64 `[N]` in ascending order, which makes copies."""


def pixel_numbers(pixels: Pixels, device: torch.device | str = "cpu") -> Tensor:
    """The flat indices as int64 `[N]`; of a slice, which names its first and end."""
    return torch.arange(pixels.start, pixels.stop, device=device) if isinstance(pixels, slice) else pixels


def box_pixels(box: tuple[int, int, int, int], width: int) -> Tensor:
    """Pixels of the box x, y, width, height in a frame `width` pixels wide, int64 `[N]`."""
    left, top, across, down = box
    return (torch.arange(top, top + down)[:, None] * width + torch.arange(left, left + across)).flatten()
