"""Colour: luminance and the sRGB transfer function."""

from __future__ import annotations

import numpy as np

LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Rec.709 luminance of linear red, green and blue."""
LUMINANCE = np.array(LUMINANCE_WEIGHTS)


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Linear float32 values of sRGB-encoded ones (IEC 61966-2-1)."""
    low = encoded / 12.92
    high = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)
