"""The weights of lens samples as a control variate for the radiance.

Weights W / (A q) have the mean 1 in every pixel. Where the radiance is constant, all noise comes from the weights, and
radiance - c (weight - 1) is free of noise. Near guided highlights the correlation is low. The coefficient c is the slope of a
regression over earlier epochs: a c from the same epoch would bias the picture. Where an edge crosses a cell, c is wrong for some
pixels: |c| is at most the pixel's own mean radiance of earlier epochs. A dark pixel stays exactly dark, and no mean is negative
where the mean weight stays below 2.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import pad, unfold

from bokehguide.guiding.protocols import ModeContext
from bokehguide.render.vector import luminance
from bokehguide.runtime.distributed import ROWS_PER_BAND, RankSums
from bokehguide.runtime.indexing import Pixels, gather_pixels, pixel_numbers

CELL = 4
"""Pixels along the side of the squares that have a coefficient of their own; bands of rows hold whole squares."""
MIN_WEIGHT_VARIANCE = 1e-3
"""Variance of weights below which the weights count as constant."""


class NoControlVariate(nn.Module):
    """Leaves the radiance as it is."""

    def corrected(self, places: Pixels, radiance: Tensor, weight: Tensor) -> Tensor:
        return radiance

    def update(self, picture: Callable[[], Tensor]) -> None:
        pass

    def merge(self) -> None:
        pass


class ControlVariate(RankSums):
    """Learns coefficients for a film, cell by cell.

    shrinkage: squared standard errors of a coefficient that halve it where they equal its square; of samples without reuse.
    sums: `[8, cells]`, of samples, weights w, w², w v, v², and v in its three channels. v is the radiance, in w v and v² its
    luminance.
    """

    coefficients: Tensor
    bound: Tensor

    def __init__(self, context: ModeContext, shrinkage: float):
        assert ROWS_PER_BAND % CELL == 0
        width, height, device = context.film_width, context.film_height, context.camera.position.device
        self._width, self._across, self._shrinkage = width, -(-width // CELL), shrinkage
        cells = self._across * -(-height // CELL)
        super().__init__(torch.zeros(8, cells, dtype=torch.float64, device=device), context.ranks)
        self.register_buffer("coefficients", torch.zeros(3, cells, device=device))
        self.register_buffer("bound", torch.zeros(3, width * height, device=device))
        """Largest |c| of each pixel."""

    def corrected(self, places: Pixels, radiance: Tensor, weight: Tensor) -> Tensor:
        """Radiance less c (weight - 1), `[3, N]`; the samples are added to the sums."""
        self.add(places, radiance, weight)
        return radiance - self.coefficient(places) * (weight - 1.0)

    def _cells(self, places: Pixels) -> Tensor:
        numbers = pixel_numbers(places, self.coefficients.device)
        return numbers // self._width // CELL * self._across + numbers % self._width // CELL

    def coefficient(self, places: Pixels) -> Tensor:
        """c `[3, N]` of some pixels of the film, 0 in the first epoch."""
        bound = gather_pixels(self.bound, places)
        return self.coefficients.index_select(1, self._cells(places)).clamp(-bound, bound)

    def add(self, places: Pixels, radiance: Tensor, weight: Tensor) -> None:
        """Add samples `[3, N]` with their weights `[N]`. Samples that are not finite count for none."""
        radiance, weight = radiance.double(), weight.double()  # squares of large float32 numbers overflow
        light = luminance(radiance)
        rows = torch.stack((torch.ones_like(light), weight, weight * weight, weight * light, light * light, *radiance))
        rows *= (weight + light).isfinite()
        self.mine.index_add_(1, self._cells(places), rows.nan_to_num(0.0, 0.0, 0.0))

    def update(self, picture: Callable[[], Tensor]) -> None:
        """End an epoch: set the coefficients by all samples so far; collective. picture: see `StepSummary`."""
        self.merge()
        self.bound.copy_(self.ranks.total(picture()).clamp(min=0.0))
        count, weight, squares, product, light_squares = self.sums[:5]
        count = count.clamp(min=1.0)
        color = self.sums[5:] / count
        light = luminance(color)
        variance = squares / count - (weight / count).square()
        covariance = product / count - light * weight / count
        slope = covariance / variance.clamp(min=MIN_WEIGHT_VARIANCE)
        residual = (light_squares / count - light * light - covariance * slope).clamp(min=0.0)
        error = residual / (variance.clamp(min=MIN_WEIGHT_VARIANCE) * count)
        trust = slope * slope / (slope * slope + self._shrinkage * error).clamp(min=1e-300)
        self.coefficients.copy_(self._median(slope * trust) * color / light.clamp(min=1e-300))

    def _median(self, values: Tensor) -> Tensor:
        """The median over each cell and the cells around it, `[cells]`."""
        image = pad(values.reshape(1, 1, -1, self._across), (1, 1, 1, 1), mode="replicate")
        return unfold(image, 3)[0].median(0).values
