"""The `[camera.aperture]` table of a scene file: the shape of the lens's opening."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from bokehguide.scene.lamps import LUMINANCE
from bokehguide.scene.tables import CAT_EYE, RATIO, SHARE, SIGNED_SHARE, Table
from bokehguide.scene.types import Aperture

KEYS = ("blades", "rotation", "curvature", "ratio", "image", "cat_eye", "edge")
NEEDS = {"rotation": ("blades", "image"), "curvature": ("blades",)}
"""Keys that do nothing without one of others."""
MOST_BLADES = 64


def read_aperture(camera: Table, files: SceneFiles) -> Aperture | None:
    """The aperture of a `[camera]` table, None where it is round; `files` are those that its image may be.

    Raises BokehguideError for unknown keys, values out of range, contradictions, keys that do
    nothing, and an image that cannot be read or lets nothing through.
    """
    values = camera.values.get("aperture")
    if values is None:
        return None
    table = Table(values, camera.file, "camera.aperture", KEYS)
    for key in ("blades", "curvature", "edge"):
        table.exclusive("image", key)
    blades = _blades(table)
    for key, needed in NEEDS.items():
        if key in table and not any(table.values.get(name) for name in needed):
            table.fail(key, f"has no {' or '.join(needed)} beside it; give one of them or leave it out")
    if "aperture_radius" not in camera and "f_number" not in camera:
        camera.fail("aperture", "is the shape of a pinhole; give f_number or aperture_radius in [camera]")
    return Aperture(
        blades=blades,
        rotation=table.number("rotation", Aperture.rotation),
        curvature=table.number("curvature", Aperture.curvature, SHARE),
        ratio=table.number("ratio", Aperture.ratio, RATIO),
        image=_image(table, files) if "image" in table else None,
        cat_eye=table.number("cat_eye", Aperture.cat_eye, CAT_EYE),
        edge=table.number("edge", Aperture.edge, SIGNED_SHARE),
    )


def _blades(table: Table) -> int:
    blades = table.values.get("blades", Aperture.blades)
    if type(blades) is not int or blades != 0 and not 3 <= blades <= MOST_BLADES:
        table.fail("blades", f"is out of range; give a whole number from 3 to {MOST_BLADES}, or 0 for a round aperture")
    return blades


def _image(table: Table, files: SceneFiles) -> np.ndarray:
    """Grey levels, taken as they stand, times opacity: float32 `[H, W]`."""
    texels = load_texture(files.named(table, "image"), files, srgb=False, alpha=True)
    mask = texels[..., :3] @ LUMINANCE.astype(np.float32)
    mask = mask * texels[..., 3] if texels.shape[2] == 4 else mask
    if not mask.any():
        table.fail("image", "is black all over and lets no light through; give one with something brighter")
    return mask
