"""Anisotropic roughness of other renderers, which have an α along u and an α along v, in the terms of `Material`."""

from __future__ import annotations

import math
from typing import Any


def from_alphas(along_u: float, along_v: float) -> dict[str, Any]:
    """The fields `roughness`, `anisotropy` and `anisotropy_rotation` of a `Material`.

    The smaller α is that of `roughness`. The larger α is α + (1 - α) anisotropy², as in KHR_materials_anisotropy.
    """
    along_u, along_v = (min(max(alpha, 0.0), 1.0) for alpha in (along_u, along_v))
    least, most = sorted((along_u, along_v))
    anisotropy = math.sqrt((most - least) / (1.0 - least)) if most > least else 0.0
    rotation = 90.0 if along_v > along_u else 0.0
    return {"roughness": math.sqrt(least), "anisotropy": anisotropy, "anisotropy_rotation": rotation}


def to_alphas(roughness: float, anisotropy: float) -> tuple[float, float]:
    """The larger and the smaller α of a `Material`."""
    least = roughness**2
    return least + (1.0 - least) * anisotropy**2, least
