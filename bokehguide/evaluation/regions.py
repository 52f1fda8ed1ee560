"""Regions of the frame, and errors over them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.metrics import mape, relmse
from bokehguide.scene.types import Scene

MEASURES = ("mape", "relmse")


def regions(scene: Scene) -> dict[str, Tensor]:
    """Masks of the regions, bool `[H, W]`: `frame`; for a scene with insets also `insets`, their union, and `inset-1`, ..."""
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
    """Ratio of two means, its standard error, and z: the difference of the means over its standard error."""

    ratio: float
    standard_error: float
    z: float


def mean_ratio(light: Tensor, other: Tensor, variance: Tensor) -> MeanRatio:
    """Ratio of the means of luminances `[N]` of two independent images; variance: of their differences `[N]`."""
    first, second = float(light.double().mean()), float(other.double().mean())
    error = float(variance.double().sum().sqrt()) / light.numel()
    scale = max(second, 1e-30)
    return MeanRatio(first / scale, error / scale, (first - second) / max(error, 1e-30))


def between_halves(first: Tensor, mean: Tensor) -> dict[str, float]:
    """MAPE and relMSE between two halves relative to their mean. first, mean: radiance `[H, W, 3]`.

    The difference of a half from the mean is half the difference of the halves.
    """
    return {"mape": 2 * mape(first, mean), "relmse": 4 * relmse(first, mean)}
