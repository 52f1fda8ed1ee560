"""Where on the frame errors are measured, and how."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.metrics import mape, relmse
from bokehguide.scene.types import Scene

MEASURES = ("mape", "relmse")


def regions(scene: Scene) -> dict[str, Tensor]:
    """Pixels by region, bool `[H, W]`: `frame`; of a scene with insets also `insets`, all together, and `inset-1`, ..."""
    width, height = scene.film.width, scene.film.height
    frame = torch.ones(height, width, dtype=torch.bool)
    found = {"frame": frame}
    if scene.insets:
        found["insets"] = torch.zeros_like(frame)
    for number, inset in enumerate(scene.insets, start=1):
        box = inset.pixels(width, height)
        found["insets"][box] = True
        found[f"inset-{number}"] = torch.zeros_like(frame)
        found[f"inset-{number}"][box] = True
    return found


def errors(image: Tensor, reference: Tensor, mask: Tensor) -> dict[str, float]:
    """MAPE and relMSE of radiance `[H, W, 3]` over the pixels of a mask, by the names in MEASURES."""
    pixels, expected = image[mask][None], reference[mask][None]
    return {"mape": mape(pixels, expected), "relmse": relmse(pixels, expected)}


class MeanRatio(NamedTuple):
    """A mean over another one, its standard error, and by how many of them it is off 1."""

    ratio: float
    standard_error: float
    z: float


def mean_ratio(light: Tensor, other: Tensor, variance: Tensor) -> MeanRatio:
    """Of the luminances `[N]` of two independent pictures' pixels; variance: of their differences `[N]`."""
    first, second = float(light.double().mean()), float(other.double().mean())
    error = float(variance.double().sum().sqrt()) / light.numel()
    scale = max(second, 1e-30)
    return MeanRatio(first / scale, error / scale, (first - second) / max(error, 1e-30))


def between_halves(first: Tensor, mean: Tensor) -> dict[str, float]:
    """MAPE and relMSE between two halves, radiance `[H, W, 3]`, relative to their mean.

    Either half is half their difference away from it.
    """
    return {"mape": 2 * mape(first, mean), "relmse": 4 * relmse(first, mean)}
