"""The `[camera.aperture]` table of a scene file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.scene.checks import iris_blades
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from bokehguide.scene.tables import CAT_EYE, FRACTION, RATIO, SIGNED_FRACTION, Table, override_place
from bokehguide.scene.types import Aperture

KEYS = ("blades", "rotation", "curvature", "ratio", "image", "cat_eye", "edge")
NEEDS = {"rotation": ("blades", "image"), "curvature": ("blades",)}
"""Keys that have no effect without one of the listed keys."""
SHAPES = ("blades", "curvature", "edge")
"""Keys that an image replaces."""


@dataclass(frozen=True)
class _Mask:
    """The mask of a Scene under the key `image`: texels `[H, W]`, shown in one line."""

    texels: np.ndarray

    def __repr__(self) -> str:
        height, width = self.texels.shape
        return f"a mask of {width} × {height} texels"


def aperture_table(aperture: Aperture) -> dict[str, Any]:
    """The fields of `aperture` that differ from the defaults and have an effect, as the table that `read_aperture` takes."""
    left_out = ("image",) if aperture.image is None else SHAPES
    given = {key: value for key, value in vars(aperture).items() if key not in left_out}
    given = {key: value for key, value in given.items() if key == "image" or value != getattr(Aperture, key)}
    if aperture.image is not None:
        given["image"] = _Mask(aperture.image)
    return {key: value for key, value in given.items() if key not in NEEDS or given.keys() & set(NEEDS[key])}


class _Shape(Table):
    """The table of an aperture, some of whose keys come from the command line.

    overrides: replace keys of `values`; keys that contradict them are left out.
    """

    def __init__(self, values: Any, file: str, overrides: dict[str, Any]):
        self.overrides = overrides
        super().__init__(values, file, "camera.aperture", KEYS)
        left_out = SHAPES if "image" in overrides else ("image",) if "blades" in overrides else ()
        if overrides.get("blades") == 0:
            left_out = (*left_out, "rotation", "curvature")
        self.values = {key: value for key, value in self.values.items() if key not in left_out} | overrides

    def place(self, key: str) -> str:
        """The field and the command-line option for an override, the location in the file for another key."""
        return override_place(f"aperture_{key}") if key in self.overrides else super().place(key)


def read_aperture(camera: Table, files: SceneFiles, overrides: dict[str, Any]) -> Aperture | None:
    """The aperture of the table `camera`; None is a disc.

    files: the files that the table may name. overrides: keys from the command line, which replace those of the table; the path
    of an image is then the user's own.

    Raises BokehguideError for unknown keys, values out of range, contradictory keys, keys without
    effect, and an image that is unreadable or black.
    """
    values = camera.values.get("aperture")
    if values is None and not overrides:
        return None
    table = _Shape({} if values is None else values, camera.file, overrides)
    for key in SHAPES:
        table.exclusive("image", key)
    blades = iris_blades(table, Aperture.blades)
    for key, needed in NEEDS.items():
        if key in table and not any(table.values.get(name) for name in needed):
            table.fail(key, f"has no {' or '.join(needed)} beside it; give one of them or leave it out")
    if "aperture_radius" not in camera and "f_number" not in camera:
        if overrides:
            table.fail(next(iter(overrides)), "has no effect on a pinhole; give an f-number or an aperture radius too")
        camera.fail("aperture", "has no effect on a pinhole; give f_number or aperture_radius in [camera]")
    return Aperture(
        blades=blades,
        rotation=table.number("rotation", Aperture.rotation),
        curvature=table.number("curvature", Aperture.curvature, FRACTION),
        ratio=table.number("ratio", Aperture.ratio, RATIO),
        image=_image(table, files) if "image" in table else None,
        cat_eye=table.number("cat_eye", Aperture.cat_eye, CAT_EYE),
        edge=table.number("edge", Aperture.edge, SIGNED_FRACTION),
    )


def _image(table: _Shape, files: SceneFiles) -> np.ndarray:
    """The mask: luminance of the encoded image, times alpha, float32 `[H, W]`."""
    given = table.values["image"]
    if isinstance(given, _Mask):
        return given.texels
    path = Path(table.text("image")) if "image" in table.overrides else files.named(table, "image")
    texels = load_texture(path, files, srgb=False, alpha=True)
    mask = texels[..., :3] @ LUMINANCE.astype(np.float32)
    mask = mask * texels[..., 3] if texels.shape[2] == 4 else mask
    if not mask.any():
        table.fail("image", "is black all over and lets no light through; give an image with brighter pixels")
    return mask
