"""What the page shows of one pixel: its values, and where on the lens its samples go."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bokehguide.guiding.protocols import PixelBatch
from bokehguide.render import PixelRandom
from bokehguide.render.film import NO_DEPTH
from bokehguide.scene.sight import coc_diameter
from bokehguide.train import RenderLoop

GRID = 48
"""Cells across the lens."""
DRAWS = 256
"""Lens points that the page shows as dots."""
SEED = 7_100_000
"""Seed of the shown draws; the draws are not in the picture."""
DIMMEST, BRIGHTEST = 0.1, 300.0
"""Densities, relative to a uniform lens, of the lowest and the highest value of the disc."""


def pixel_facts(loop: RenderLoop, layers: dict[str, np.ndarray], x: float, y: float) -> dict[str, Any]:
    """Values of the pixel at a point of the frame, in fractions, and its lens disc, as JSON values.

    layers: of the loop's film.
    """
    width, height = loop.film.width, loop.film.height
    column, row = min(int(x * width), width - 1), min(int(y * height), height - 1)
    values = {name: np.asarray(layer[row, column], np.float64).tolist() for name, layer in layers.items()}
    depth = values.pop("depth")
    met = depth < 0.5 * NO_DEPTH
    beta = loop.guide_images().get("beta")
    confusion = float(coc_diameter(loop.scene.camera, loop.scene.film, depth if met else np.inf))
    return {
        "pixel": [column, row],
        "reduced": [width, height],
        **values,
        "depth": depth if met else None,
        "confusion": confusion,
        "beta": 0.0 if beta is None else float(beta[row, column, 0]),
        "lens": lens_disc(loop, row * width + column) if loop.camera.lens.radius > 0.0 else None,
    }


@torch.no_grad()
def lens_disc(loop: RenderLoop, index: int) -> dict[str, Any]:
    """Density of the lens points of a pixel over the lens, and some draws.

    cells: `[GRID, GRID]` bytes in base64, top row first: 0 outside the aperture, else 1 to 255 for the logarithm of the density
    relative to a uniform lens, from DIMMEST to BRIGHTEST. draws: lens points over the radius. highest: largest density of a cell,
    relative to a uniform lens.
    """
    lens = loop.camera.lens
    steps = (torch.arange(GRID) + 0.5) / (0.5 * GRID) - 1.0
    x, y = torch.meshgrid(steps, -steps, indexing="xy")
    points = torch.stack((x.flatten(), y.flatten())) * lens.radius
    batch = _pixel_batch(loop, index, points.shape[1])
    open_ = lens.transmission(points) * lens.unblocked(points, batch.focus) > 0.0
    relative = loop.mode.lens.query(batch).pdf(points).expand(points.shape[1]) * lens.area
    span = np.log(BRIGHTEST / DIMMEST)
    level = (relative.clamp(DIMMEST, BRIGHTEST) / DIMMEST).log() / span
    cells = torch.where(open_, 1.0 + (254.0 * level).round(), 0.0).to(torch.uint8)
    drawn = loop.mode.lens.query(_pixel_batch(loop, index, DRAWS)).sample().points
    drawn = (drawn / lens.radius)[:, lens.contains(drawn)]
    return {
        "grid": GRID,
        "cells": base64.b64encode(cells.numpy().tobytes()).decode(),
        "draws": [[round(value, 4) for value in point] for point in drawn.T.tolist()],
        "highest": float(torch.where(open_, relative, 0.0).max()),
    }


def _pixel_batch(loop: RenderLoop, index: int, count: int) -> PixelBatch:
    """A batch of `count` times the same pixel, with focus points spread over the pixel."""
    random = PixelRandom(SEED, loop.step_number + 1, torch.arange(count))
    pixels = torch.full((count,), index)
    corner = torch.tensor([[index % loop.camera.width], [index // loop.camera.width]])
    subpixel: Tensor = random.stratified(0, 2)
    raster = corner + subpixel
    focus = loop.camera.focus_points(raster)
    return PixelBatch(loop.step_number + 1, pixels, pixels, raster, subpixel, focus, random, 1.0)
