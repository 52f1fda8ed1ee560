"""Russian roulette of shadow rays: light that hardly changes a pixel is tested for shadow less often.

Many light samples are dark against the noise of their pixel, such as light on a dim wall in a bright circle of confusion. The
shadow rays of these samples cost as much as all others. The roulette traces a shadow ray with a probability in proportion to the
light of the sample, and divides the light that arrives by the probability. The expected value stays the same. A ray adds at
most SHARE² / 4 of the pixel's variance. Cycles and Arnold thin out shadow rays in the same way, but with a constant threshold.

The roulette has random numbers of its own, so that thresholds may depend on earlier samples. With cells of one pixel, a
threshold depends on the samples of its pixel alone, so that a crop has the bits of the frame.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool2d

from bokehguide.render.film import Film
from bokehguide.render.vector import divisor
from bokehguide.runtime.indexing import Pixels, gather_pixels

SHARE = 0.5
"""Threshold over the standard deviation of a pixel's samples."""
MIN_CHANCE = 0.25
"""Least probability of tracing a shadow ray, so that no light is multiplied by more than 4."""

MIRROR_PDF = 4.0
"""Least density of a BSDF sample, per steradian, at which the light sample of a path does not play. Such light samples tell where
the virtual images in mirrors are."""


def roulette_factor(light: Tensor, threshold: Tensor, uniforms: Tensor) -> Tensor:
    """Factors `[N]` of light samples: 0 for samples that end, else one over the probability of survival.

    light: largest channels of the unshadowed contributions. threshold: light from which on samples always survive. uniforms:
    uniform numbers. The expected value of a factor is 1. Samples without light, and of NaN, have the factor 1.
    """
    chance = torch.where(light > 0.0, (light / divisor(threshold)).clamp(MIN_CHANCE, 1.0), 1.0)
    return (uniforms < chance) / chance


class ShadowRoulette(nn.Module):
    """The thresholds of the pixels of a film.

    cell: side, in pixels, of the cells in which all pixels have the least threshold of the cell, for modes whose pixels use light
    samples of other pixels. Groups that share samples may cross the sides of cells. 0 switches the roulette off.
    threshold: light of a shadow ray times the weight of the lens point, float32 `[pixels]`, 0 before the third step.
    """

    threshold: Tensor

    def __init__(self, width: int, height: int, cell: int, device: torch.device | str = "cpu"):
        super().__init__()
        self._width, self._height, self._cell = width, height, cell
        self.register_buffer("threshold", torch.zeros(width * height if cell else 0, device=device))

    @torch.no_grad()
    def update(self, film: Film) -> None:
        """Compute the thresholds from the samples on the film."""
        if self._cell > 0:
            deviation = film.variance().sqrt_().mul_(film.counts().sqrt())  # finite for any radiance
            self.threshold.copy_(self._least(SHARE * deviation).reshape(-1))

    def _least(self, values: Tensor) -> Tensor:
        """The least of the values `[H, W]` in the cell of each pixel."""
        if self._cell == 1:
            return values
        least = -max_pool2d(-values[None], self._cell, ceil_mode=True)[0]
        rows = least.repeat_interleave(self._cell, 0)[: self._height]
        return rows.repeat_interleave(self._cell, 1)[:, : self._width]

    def thresholds(self, places: Pixels, weight: Tensor) -> Tensor | None:
        """Thresholds `[N]` for light along the rays of some pixels; None without roulette.

        places: pixels of the film. weight: of the lens points, `[N]`.
        """
        return gather_pixels(self.threshold, places) / divisor(weight) if self._cell > 0 else None
