"""Estimators of the means of a pixel's features from weighted samples.

The features are rows of numbers: alpha, hit, depth, normal and albedo of a `Film`, or the objects that a `Coverage` has found.

The weights w of lens samples vary more than the features x, so that the plain mean of w x is noisy. All estimators are sums over
samples, in double precision.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.vector import divisor
from bokehguide.runtime.indexing import Pixels, gather_pixels, scatter, scatter_add

FEATURES = 9
"""Alpha, hit, depth times hit, normal and albedo of a film."""


class MeanFeatures:
    """Estimator for samples with weights of 1: the mean of x. rows: number of features, F."""

    def __init__(self, pixels: int, device: torch.device | str = "cpu", rows: int = FEATURES):
        self._sum = torch.zeros(rows, pixels, dtype=torch.float64, device=device)

    def sums(self) -> dict[str, Tensor]:
        """Running sums by name, `[F, pixels]` each in this class. A film saves these sums."""
        return {"features": self._sum}

    def recenter(self, pixels: Pixels) -> None:
        """Compute the control variate of the given pixels again, from all samples so far."""

    def forget(self, row: Tensor, pixels: Tensor) -> None:
        """Set a feature of each of K pixels back to 0, as before the first sample; row, pixels: int64 `[K]`."""
        self._sum[row, pixels] = 0.0

    def initialise(self, pixels: Pixels, features: Tensor) -> None:
        """Compute the first control variate from samples `[F, N]` of weight 1 that are not in the picture."""

    def add(self, pixels: Pixels, features: Tensor, weight: Tensor, kept: Tensor) -> None:
        """Add samples `[F, N]` with weights `[N]`; kept: 1 for samples in the picture, else 0, `[N]`."""
        scatter_add(self._sum, pixels, features * kept)

    def means(self, count: Tensor, pixels: Pixels = slice(None)) -> Tensor:
        """Estimates `[F, N]` of N pixels; count: number of their samples in the picture, at least 1, `[N]`."""
        return gather_pixels(self._sum, pixels) / count


class RatioFeatures(MeanFeatures):
    """Estimator for a vignetting lens: Σ w x / Σ w.

    With vignetting, the mean of w is below 1. The ratio keeps the features from darkening towards the corners of the frame.
    """

    def __init__(self, pixels: int, device: torch.device | str = "cpu", rows: int = FEATURES):
        super().__init__(pixels, device, rows)
        self._weight = torch.zeros(pixels, dtype=torch.float64, device=device)

    def sums(self) -> dict[str, Tensor]:
        """See `MeanFeatures`."""
        return {**super().sums(), "passed": self._weight}

    def add(self, pixels: Pixels, features: Tensor, weight: Tensor, kept: Tensor) -> None:
        """See `MeanFeatures`."""
        scatter_add(self._sum, pixels, features * (weight * kept))
        scatter_add(self._weight, pixels, weight * kept)

    def means(self, count: Tensor, pixels: Pixels = slice(None)) -> Tensor:
        """See `MeanFeatures`."""
        return gather_pixels(self._sum, pixels) / divisor(gather_pixels(self._weight, pixels), 1e-20)


class ControlVariateFeatures(MeanFeatures):
    """Estimator with the weight as a control variate: the mean of w (x - c) + c.

    The mean of w is 1, and c comes from earlier samples, so that the estimate is unbiased. Where x is constant, the estimate is
    exact: alpha is exactly 1 where every sample is opaque. c = Σ w² x / Σ w² is a mean of earlier values, and close to the
    optimum (E[w² x] - E[x]) / (E[w²] - 1). `initialise` provides c if the weight of the first sample may differ from 1.
    """

    def __init__(self, pixels: int, device: torch.device | str = "cpu", rows: int = FEATURES):
        super().__init__(pixels, device, rows)
        self._moments = torch.zeros(1 + rows, pixels, device=device)
        """Σ w² and Σ w² x."""
        self._center = torch.zeros(rows, pixels, device=device)

    def sums(self) -> dict[str, Tensor]:
        """See `MeanFeatures`."""
        return {**super().sums(), "control": self._moments, "center": self._center}

    def forget(self, row: Tensor, pixels: Tensor) -> None:
        """See `MeanFeatures`."""
        super().forget(row, pixels)
        self._moments[1 + row, pixels] = 0.0
        self._center[row, pixels] = 0.0

    def recenter(self, pixels: Pixels) -> None:
        """See `MeanFeatures`."""
        moments = gather_pixels(self._moments, pixels)
        scatter(self._center, pixels, moments[1:] / divisor(moments[0]))

    def initialise(self, pixels: Pixels, features: Tensor) -> None:
        """See `MeanFeatures`."""
        scatter_add(self._moments[0], pixels, torch.ones_like(features[0]))
        scatter_add(self._moments[1:], pixels, features)

    def add(self, pixels: Pixels, features: Tensor, weight: Tensor, kept: Tensor) -> None:
        """See `MeanFeatures`."""
        # w (x - c) + c
        scatter_add(self._sum, pixels, torch.lerp(gather_pixels(self._center, pixels), features, weight).mul_(kept))
        square = weight * weight
        scatter_add(self._moments[0], pixels, square)
        scatter_add(self._moments[1:], pixels, features * square)
