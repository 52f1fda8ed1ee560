"""The picture of `bokehguide info --picture`: a quick pinhole view with the plane of focus and the discs of emitters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from torch import Tensor

from bokehguide.image import Display, replacing, to_8_bit
from bokehguide.render.film import NO_DEPTH
from bokehguide.scene import Scene
from bokehguide.scene.inspection import Inspection
from bokehguide.scene.sight import coc_diameter
from bokehguide.train import RenderLoop, RenderSettings

WIDTH, SPP = 640, 16
"""Largest width of the view in pixels, and its samples per pixel."""
SHARP = 1.0
"""Diameter in pixels of the picture of the largest circle of confusion that counts as in focus."""
BAND, CONTOUR, DISC = (64, 224, 255), (255, 64, 160), (255, 208, 64)
"""Colours of the part in focus, of the line where the plane of focus cuts surfaces, and of circles of confusion."""


def write_focus_view(path: Path, scene: Scene, facts: Inspection) -> None:
    """Write the view as a PNG. Raises BokehguideError if the folder cannot be written."""
    radiance, depth = _pinhole_view(scene)
    picture = to_8_bit(Display().show(radiance)).astype(np.float32)
    scale = depth.shape[1] / scene.film.width
    _mark_focus(picture, scene, depth)
    image = Image.fromarray(picture.round().astype(np.uint8))
    draw = ImageDraw.Draw(image)
    for emitter in facts.emitters:
        (x, y), radius = emitter.pixel, max(0.5 * emitter.coc, 1.0)
        draw.ellipse([scale * (x - radius), scale * (y - radius), scale * (x + radius), scale * (y + radius)], outline=DISC)
    with replacing(path) as temporary:
        image.save(temporary, format="PNG")


def _pinhole_view(scene: Scene) -> tuple[Tensor, np.ndarray]:
    """Radiance `[H, W, 3]`, and depth `[H, W]` in metres, inf without a surface, through a pinhole."""
    film = scene.film
    width = min(film.width, WIDTH)
    small = replace(film, width=width, height=max(1, round(film.height * width / film.width)))
    camera = replace(scene.camera, aperture_radius=0.0, aperture=None)
    with RenderLoop(replace(scene, camera=camera, film=small), RenderSettings("uniform", spp=SPP)) as loop:
        for _ in range(SPP):
            loop.step()
    depth = loop.film.layers()["depth"]
    return loop.film.radiance().cpu(), np.where(depth < 0.5 * NO_DEPTH, depth, np.inf).squeeze()


def _mark_focus(picture: np.ndarray, scene: Scene, depth: np.ndarray) -> None:
    """Tint the part in focus of a picture `[H, W, 3]`, 0 to 255, in place, and draw the cut of the plane of focus."""
    sharp = (coc_diameter(scene.camera, scene.film, depth) <= SHARP) & np.isfinite(depth)
    picture[sharp] = 0.5 * picture[sharp] + 0.5 * np.array(BAND)
    behind = depth > scene.camera.focus_distance
    cut = np.zeros_like(behind)
    # Only along a surface: a silhouette before the plane is no cut.
    for axis in (0, 1):
        ahead = np.roll(depth, -1, axis)
        with np.errstate(invalid="ignore"):
            joined = np.abs(ahead - depth) < 0.05 * np.minimum(ahead, depth)
        change = (behind != np.roll(behind, -1, axis)) & joined
        change[(slice(-1, None), slice(None)) if axis == 0 else (slice(None), slice(-1, None))] = False
        cut |= change
    picture[cut] = CONTOUR
