"""The weights of lens samples as a control variate for the radiance.

Weights W / (A q) have the mean 1 in every pixel. Where the radiance is constant, all noise comes from the weights, and
radiance - c (weight - 1) is free of noise. Near guided highlights, the correlation is low.

The coefficient c is the slope of a linear regression of radiance on weight, for a cell of pixels and over earlier epochs. A
coefficient from the same epoch would bias the picture. Where an edge crosses a cell, the coefficient does not fit all pixels of
the cell. Therefore |c| is at most the pixel's mean radiance of earlier epochs. A dark pixel stays exactly dark, and a mean is
never negative where the mean weight is below 2. The first step has no earlier epoch, and coefficients of its own
(`cross_fitting.py`).

A light group has a share of the coefficient: its share of the pixel's mean radiance of earlier epochs. The shares add up to 1, so
that the groups add up to the radiance. A group that is dark in a pixel stays exactly dark.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad, unfold

from bokehguide.guiding.protocols import ModeContext
from bokehguide.render.vector import luminance
from bokehguide.runtime import native
from bokehguide.runtime.distributed import ROWS_PER_BAND, RankSums
from bokehguide.runtime.indexing import Pixels, core_pixels, gather_pixels, pixel_numbers
from bokehguide.scene.light_groups import find_light_groups

CELL = 4
"""Side of a cell in pixels. Each cell has one coefficient, and a band of rows contains whole cells."""
MIN_WEIGHT_VARIANCE = 1e-3
"""Least variance of weights as a divisor, so that the slopes of almost constant weights are small."""


def summands(radiance: Tensor, weight: Tensor) -> Tensor:
    """Summands of `ControlVariate.sums`, float64 `[8, N]`, of samples `[3, N]` with weights `[N]`; 0 for a sample not finite."""
    radiance, weight = radiance.double(), weight.double()  # squares of large float32 numbers overflow
    light = luminance(radiance)
    rows = torch.stack((torch.ones_like(light), weight, weight * weight, weight * light, light * light, *radiance))
    rows *= (weight + light).isfinite()
    return rows.nan_to_num(0.0, 0.0, 0.0)


class Regressions(NamedTuple):
    """Linear regressions of luminance on weight, one for each of some cells.

    slope: `[cells]`. squared_error: square of the slope's standard error, if the samples are independent. explained: share of the
    variance of the luminance that the weights explain. color: mean radiance, `[3, cells]`.
    """

    slope: Tensor
    squared_error: Tensor
    explained: Tensor
    color: Tensor

    @classmethod
    def of(cls, sums: Tensor) -> Regressions:
        """sums: as of `ControlVariate`, `[8, cells]`."""
        count, weight, squares, product, light_squares = sums[:5]
        count = count.clamp(min=1.0)
        color = sums[5:] / count
        light = luminance(color)
        variance = (squares / count - (weight / count).square()).clamp(min=MIN_WEIGHT_VARIANCE)
        covariance = product / count - light * weight / count
        slope, spread = covariance / variance, light_squares / count - light * light
        residual = (spread - covariance * slope).clamp(min=0.0)
        return cls(slope, residual / (variance * count), 1.0 - residual / spread.clamp(min=1e-300), color)


class NoControlVariate(nn.Module):
    """Null object in place of `ControlVariate`: does not change the radiance."""

    def corrected(self, places: Pixels, radiance: Tensor, weight: Tensor) -> Tensor:
        return radiance

    def shares(self, places: Pixels) -> Tensor:
        return torch.ones(())  # on any device

    def update(self, picture: Callable[[], Tensor], groups: Callable[[], Tensor] | None = None) -> None:
        pass

    def merge(self) -> None:
        pass


class ControlVariate(RankSums):
    """Learns coefficients for a film, cell by cell.

    shrinkage: factor of a coefficient's squared standard error. A coefficient whose square equals the product is halved. The
    standard error assumes independent samples.
    sums: `[8, cells]`, sums of 1, w, w², w v, v² and three channels of the radiance. w is the weight, and v the luminance.
    """

    coefficients: Tensor
    bound: Tensor
    group_shares: Tensor

    def __init__(self, context: ModeContext, shrinkage: float):
        assert ROWS_PER_BAND % CELL == 0
        width, height, device = context.film_width, context.film_height, context.camera.position.device
        self._width, self._across, self._shrinkage = width, -(-width // CELL), shrinkage
        cells = self._across * -(-height // CELL)
        super().__init__(torch.zeros(8, cells, dtype=torch.float64, device=device), context.ranks)
        self.register_buffer("coefficients", torch.zeros(3, cells, device=device))
        self.register_buffer("bound", torch.zeros(3, width * height, device=device))
        """Largest |c| of each pixel."""
        groups = len(find_light_groups(context.scene).names) if context.settings.light_groups else 0
        self.register_buffer("group_shares", torch.zeros(groups, 3, width * height, device=device), persistent=groups > 0)
        """Shares of the light groups in the coefficient of each pixel, `[G, 3, pixels]`."""

    def corrected(self, places: Pixels, radiance: Tensor, weight: Tensor) -> Tensor:
        """Radiance less c (weight - 1), `[3, N]`; the samples are added to the sums."""
        core = native.core_on(radiance.device)
        if core is not None:
            return self._corrected_by_core(core, places, radiance.contiguous(), weight.contiguous())
        self.add(places, radiance, weight)
        return radiance - self.coefficient(places) * (weight - 1.0)

    def _corrected_by_core(self, core: ModuleType, places: Pixels, radiance: Tensor, weight: Tensor) -> Tensor:
        first, pixels = core_pixels(places)
        corrected = torch.empty_like(radiance)
        geometry, learned = (first, self._width, CELL), (self.coefficients, self.bound)
        core.correct_samples(self.mine, pixels, *geometry, radiance, weight, *learned, corrected)
        return corrected

    def _cells(self, places: Pixels) -> Tensor:
        numbers = pixel_numbers(places, self.coefficients.device)
        return numbers // self._width // CELL * self._across + numbers % self._width // CELL

    def coefficient(self, places: Pixels) -> Tensor:
        """Coefficients c `[3, N]` of some pixels of the film, 0 in the first epoch."""
        bound = gather_pixels(self.bound, places)
        return self.coefficients.index_select(1, self._cells(places)).clamp(-bound, bound)

    def add(self, places: Pixels, radiance: Tensor, weight: Tensor) -> None:
        """Add samples `[3, N]` with their weights `[N]`. Samples that are not finite are ignored."""
        self.mine.index_add_(1, self._cells(places), summands(radiance, weight))

    def shares(self, places: Pixels) -> Tensor:
        """Shares of the light groups in the coefficients of some pixels of the film, `[G, 3, N]`."""
        return gather_pixels(self.group_shares, places)

    def update(self, picture: Callable[[], Tensor], groups: Callable[[], Tensor] | None = None) -> None:
        """End an epoch: compute the coefficients from all samples so far; collective. picture, groups: see `StepSummary`."""
        self.merge()
        torch.clamp(self.ranks.total(picture()), min=0.0, out=self.bound)
        if groups is not None:
            light = self.ranks.total(groups()).clamp(min=0.0)
            total = light.sum(0)
            self.group_shares.copy_(torch.where(total > 0.0, light / total.clamp(min=1e-30), 1.0 / len(light)))
        slope, error, _, color = Regressions.of(self.sums)
        trust = slope * slope / (slope * slope + self._shrinkage * error).clamp(min=1e-300)
        self.coefficients.copy_(self._median(slope * trust) * color / luminance(color).clamp(min=1e-300))

    def _median(self, values: Tensor) -> Tensor:
        """The median over each cell and the cells around it, `[cells]`."""
        image = pad(values.reshape(1, 1, -1, self._across), (1, 1, 1, 1), mode="replicate")
        return unfold(image, 3)[0].median(0).values
