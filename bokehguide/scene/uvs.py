"""Conventions of texture coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np


def turned_uvs(uvs: Any) -> np.ndarray:
    """Texture coordinates `[..., 2]` whose v runs the other way, float32."""
    return (np.asarray(uvs) * (1.0, -1.0) + (0.0, 1.0)).astype(np.float32)
