"""Tone mapping: radiance to display values."""

from __future__ import annotations

import torch
from torch import Tensor


def tone_map(radiance: Tensor, exposure: float = 0.0) -> Tensor:
    """Linear radiance `[...]` to display values in 0..1: exposure in EV, sRGB curve (IEC 61966-2-1), clip."""
    linear = (radiance * 2.0**exposure).clamp(min=0.0)
    curve = 1.055 * linear ** (1.0 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve).clamp(max=1.0)
