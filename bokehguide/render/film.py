"""The film: what the samples of each pixel add up to."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.vector import luminance

NO_DEPTH = 1e10
"""Depth of a pixel in which no ray met a surface, as Blender writes it."""
KEPT_BAD_SAMPLES = 100


class BadSample(NamedTuple):
    """A NaN or infinite sample that was kept off the film: pixel, SPP step and seed."""

    x: int
    y: int
    step: int
    seed: int


@dataclass
class FilmSamples:
    """One sample for each pixel of a batch.

    weight: W/q = 1/(A q) of Eq. 11, 0 for a draw outside the aperture, `[N]`.
    radiance: `[3, N]`, not yet weighted; alpha, depth (along the axis): `[N]`; normal,
    albedo: `[3, N]`.
    """

    weight: Tensor
    radiance: Tensor
    alpha: Tensor
    depth: Tensor
    normal: Tensor
    albedo: Tensor


class Film:
    """Running sums of a frame; batches of different pixels may be added side by side.

    Radiance is summed in double precision. Alpha is estimated as w (α - c) + c, where c
    is the mean of the pixel's earlier samples: the weights' mean is 1, so the mean is
    kept, and a pixel that is opaque (or empty) throughout gets exactly 1 (or 0).
    """

    def __init__(self, width: int, height: int, seed: int = 0, device: torch.device | str = "cpu"):
        self.width, self.height, self.seed = width, height, seed
        pixels = width * height
        self._radiance = torch.zeros(3, pixels, dtype=torch.float64, device=device)
        self._square = torch.zeros(pixels, dtype=torch.float64, device=device)
        self._count = torch.zeros(pixels, device=device)
        self._alpha = torch.zeros(pixels, device=device)
        self._seen = torch.zeros(2, pixels, device=device)  # samples inside the lens, and their alpha
        self._hits = torch.zeros(8, pixels, device=device)  # weight, depth, normal and albedo of the hits
        self.bad_count = 0
        self._bad_samples: list[BadSample] = []
        self._lock = threading.Lock()

    def add(self, first: int, samples: FilmSamples, step: int) -> Tensor:
        """Add one sample to each of the pixels from `first` on; returns the finite ones, bool `[N]`."""
        pixels = slice(first, first + samples.weight.shape[0])
        weight, radiance = samples.weight, samples.radiance
        good = (radiance * weight).sum(0).isfinite()
        if not bool(good.all()):
            self._report_bad((~good).nonzero()[:, 0] + first, step)
            weight, radiance = weight.nan_to_num(0.0, 0.0, 0.0), radiance.nan_to_num(0.0, 0.0, 0.0)
        kept = good.to(torch.float32)
        weight = weight * kept
        value = radiance * weight
        self._radiance[:, pixels] += value
        self._square[pixels] += luminance(value.double()).square()
        self._count[pixels] += kept
        self._add_alpha(pixels, weight, samples.alpha, kept)
        hit_weight = weight * (samples.depth < NO_DEPTH)
        sums = self._hits
        sums[0, pixels] += hit_weight
        sums[1, pixels] += hit_weight * samples.depth
        sums[2:5, pixels] += hit_weight * samples.normal
        sums[5:8, pixels] += hit_weight * samples.albedo
        return good

    def _add_alpha(self, pixels: slice, weight: Tensor, alpha: Tensor, kept: Tensor) -> None:
        seen = self._seen[:, pixels]
        control = seen[1] / seen[0].clamp(min=1.0)
        self._alpha[pixels] += kept * (weight * (alpha - control) + control)
        inside = kept * (weight > 0.0)
        seen[0] += inside
        seen[1] += inside * alpha

    def _report_bad(self, pixels: Tensor, step: int) -> None:
        found = [BadSample(p % self.width, p // self.width, step, self.seed) for p in pixels.tolist()]
        with self._lock:
            self.bad_count += len(found)
            earliest = sorted(self._bad_samples + found, key=lambda bad: (bad.step, bad.y, bad.x))
            self._bad_samples = earliest[:KEPT_BAD_SAMPLES]

    @property
    def bad_samples(self) -> list[BadSample]:
        """The first samples that were not finite, in the order of steps and pixels."""
        return list(self._bad_samples)

    def radiance(self) -> Tensor:
        """Mean radiance so far, float32 `[H, W, 3]`."""
        mean = self._radiance / self._count.clamp(min=1.0)
        return mean.float().T.reshape(self.height, self.width, 3)

    def mean_luminance(self) -> float:
        """Mean luminance of the frame so far."""
        total = luminance(self._radiance).cpu().numpy().sum()  # in an order that no thread count changes
        return float(total / max(1.0, self._count.cpu().numpy().sum()))

    def variance(self) -> Tensor:
        """Estimated variance of the mean luminance, float32 `[H, W]`; 0 before the second sample."""
        count = self._count.double().clamp(min=1.0)
        mean = luminance(self._radiance) / count
        spread = (self._square / count - mean * mean).clamp(min=0.0) / (count - 1.0).clamp(min=1.0)
        return spread.float().reshape(self.height, self.width)

    def relative_noise(self) -> float:
        """Estimated standard error of the mean over the mean (plus 0.01), averaged over the frame."""
        mean = luminance(self.radiance().reshape(-1, 3).T)
        return float((self.variance().reshape(-1).sqrt() / (mean + 0.01)).mean())

    def layers(self) -> dict[str, np.ndarray]:
        """The frame as contiguous float32 arrays `[H, W]` or `[H, W, 3]` by name.

        depth, normal and albedo are weighted means over the samples that met a surface.
        """
        shape = (self.height, self.width)
        weight = self._hits[0]
        means = self._hits[1:] / weight.clamp(min=1e-20)
        depth = means[0] + (weight <= 0.0) * NO_DEPTH
        layers = {
            "beauty": self.radiance(),
            "alpha": (self._alpha / self._count.clamp(min=1.0)).reshape(shape),
            "depth": depth.reshape(shape),
            "normal": means[1:4].T.reshape(*shape, 3),
            "albedo": means[4:7].T.reshape(*shape, 3),
            "variance": self.variance(),
            "sample_count": self._count.reshape(shape),
        }
        return {name: np.ascontiguousarray(layer.cpu().numpy(), np.float32) for name, layer in layers.items()}
