"""A warning for models in formats without a unit of length that may have another unit than metres."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bokehguide.scene.types import Mesh

WITHOUT_UNIT = (".obj", ".ply", ".stl")
"""Formats of models that have no unit of length."""
LONG = 100.0
"""Longest side in metres of a model from which on the warning comes. A part of 10 cm in millimetres has this length."""


def unit_warning(path: Path, meshes: tuple[Mesh, ...]) -> Iterator[str]:
    """A warning if the file at `path` has no unit, and the longest side of its meshes is LONG or more."""
    if path.suffix.lower() not in WITHOUT_UNIT:
        return
    low = np.min([mesh.vertices.min(axis=0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(axis=0) for mesh in meshes], axis=0)
    side = float(np.max(high - low))
    if side >= LONG:
        yield (
            f"{path.name}: the model is {side:.3g} m long, as {path.suffix.lower()} files have no unit; if its unit is the "
            "millimetre, give scale = 0.001 in an [[object]] of a scene file"
        )
