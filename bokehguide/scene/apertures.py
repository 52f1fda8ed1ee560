"""The `[camera.aperture]` table of a scene file."""

from __future__ import annotations

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.scene.checks import iris_blades
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from bokehguide.scene.tables import CAT_EYE, FRACTION, RATIO, SIGNED_FRACTION, Table
from bokehguide.scene.types import Aperture

KEYS = ("blades", "rotation", "curvature", "ratio", "image", "cat_eye", "edge")
NEEDS = {"rotation": ("blades", "image"), "curvature": ("blades",)}
"""Keys that have no effect without one of the listed keys."""


def read_aperture(camera: Table, files: SceneFiles) -> Aperture | None:
    """The aperture of the table `camera`; None is a disc. files: the files that the table may name.

    Raises BokehguideError for unknown keys, values out of range, contradictory keys, keys without
    effect, and an image that is unreadable or black.
    """
    values = camera.values.get("aperture")
    if values is None:
        return None
    table = Table(values, camera.file, "camera.aperture", KEYS)
    for key in ("blades", "curvature", "edge"):
        table.exclusive("image", key)
    blades = iris_blades(table, Aperture.blades)
    for key, needed in NEEDS.items():
        if key in table and not any(table.values.get(name) for name in needed):
            table.fail(key, f"has no {' or '.join(needed)} beside it; give one of them or leave it out")
    if "aperture_radius" not in camera and "f_number" not in camera:
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


def _image(table: Table, files: SceneFiles) -> np.ndarray:
    """The mask: luminance of the encoded image, times alpha, float32 `[H, W]`."""
    texels = load_texture(files.named(table, "image"), files, srgb=False, alpha=True)
    mask = texels[..., :3] @ LUMINANCE.astype(np.float32)
    mask = mask * texels[..., 3] if texels.shape[2] == 4 else mask
    if not mask.any():
        table.fail("image", "is black all over and lets no light through; give an image with brighter pixels")
    return mask
