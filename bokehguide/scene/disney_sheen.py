"""The sheen of Disney's principled BSDF in the terms of `Material`.

Disney's BRDF is sheen (1 - metallic) (1 - cos θd)⁵ with the difference angle θd (Burley 2012). It has the albedo of a layer of
KHR_materials_sheen of one roughness within 0.01. Disney's sheen is strongest for light from the opposite side at grazing angles,
and that of glTF for light from the side of the viewer. Disney's base keeps its weight beneath the sheen.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bokehguide.scene.types import Material, Vector, as_vector

ROUGHNESS = 0.36
"""Roughness of the layer whose albedo is that of Disney's sheen, times a factor."""
COLOR = 0.088
"""Colour of this layer for Disney's sheen of 1, with the same mean albedo, weighted by the cosine."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
CLOSE_ROUGHNESS = 0.03
"""Difference in roughness that changes the mean albedo by less than a tenth."""
CLOSE_COLOR = 0.02
"""Error of a tinted colour, relative to the largest channel."""


def from_disney(sheen: float, tint: float, base_color: Vector, metallic: float) -> dict[str, Any]:
    """The fields `sheen_color` and `sheen_roughness` of a `Material`; none without a sheen. The parameters are 0 to 1."""
    color = COLOR * sheen * (1.0 - metallic) * (1.0 + tint * (_hue(base_color) - 1.0))
    return {"sheen_color": as_vector(color.clip(0.0, 1.0)), "sheen_roughness": ROUGHNESS} if color.any() else {}


def to_disney(material: Material) -> tuple[float, float] | None:
    """Disney's `sheen` and `sheen_tint`; None if no values from 0 to 1 give the sheen of a material."""
    textures = (material.sheen_color_texture, material.sheen_roughness_texture, material.metallic_roughness_texture)
    dielectric, color = 1.0 - material.metallic, np.array(material.sheen_color)
    away = abs(material.sheen_roughness - ROUGHNESS) > CLOSE_ROUGHNESS
    if any(texture is not None for texture in textures) or dielectric == 0.0 or away:
        return None
    hue = np.ones(3) if material.base_color_texture is not None else _hue(material.base_color)
    (white, tinted), *_ = np.linalg.lstsq(np.stack((np.ones(3), hue), axis=1), color, rcond=None)
    amount, tinted = float(white + tinted), float(tinted)
    tint = min(max(tinted / amount, 0.0), 1.0) if amount > 0.0 and np.ptp(hue) > 0.0 else 0.0
    error = np.abs(amount * (1.0 + tint * (hue - 1.0)) - color).max()
    sheen = amount / (COLOR * dielectric)
    return (min(sheen, 1.0), tint) if error <= CLOSE_COLOR * color.max() and 0.0 < sheen <= 1.0 + CLOSE_COLOR else None


def _hue(color: Vector) -> np.ndarray:
    """A colour divided by its luminance; white for black."""
    luminance = float(np.dot(LUMINANCE, color))
    return np.array(color) / luminance if luminance > 0.0 else np.ones(3)
