"""Colour: luminance, black bodies and the sRGB transfer function."""

from __future__ import annotations

import numpy as np

LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Rec.709 luminance of linear red, green and blue."""
LUMINANCE = np.array(LUMINANCE_WEIGHTS)
LUMENS_PER_WATT = 683.0
"""Photometric units are divided by this, so that they are radiometric ones of the same luminance."""
XYZ_TO_RGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
"""CIE XYZ to linear Rec.709 with the white point D65 (IEC 61966-2-1)."""


def blackbody(kelvin: float) -> np.ndarray:
    """The colour of a black body in linear Rec.709, float64 `[3]`, with luminance 1.

    kelvin: 1000 to 15000. The chromaticity in CIE 1960 coordinates is Krystek's rational approximation of the Planckian locus
    (An algorithm to calculate correlated colour temperature, Color Research & Application 10, 1985), whose error is at most
    1e-4. Below about 1900 K the colour lies outside Rec.709, and its blue is 0.
    """
    t = kelvin
    u = (0.860117757 + 1.54118254e-4 * t + 1.28641212e-7 * t * t) / (1.0 + 8.42420235e-4 * t + 7.08145163e-7 * t * t)
    v = (0.317398726 + 4.22806245e-5 * t + 4.20481691e-8 * t * t) / (1.0 - 2.89741816e-5 * t + 1.61456053e-7 * t * t)
    x, y = np.array([3.0 * u, 2.0 * v]) / (2.0 * u - 8.0 * v + 4.0)
    rgb = (XYZ_TO_RGB @ np.array([x / y, 1.0, (1.0 - x - y) / y])).clip(min=0.0)
    return rgb / (LUMINANCE @ rgb)


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Linear float32 values of sRGB-encoded ones (IEC 61966-2-1)."""
    low = encoded / 12.92
    high = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)
