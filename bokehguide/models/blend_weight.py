"""The blend weight β between the projected Gaussians and the uniform lens (Eq. 26), learned for each pixel."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

MIN_BLEND, MAX_BLEND = 0.05, 0.95
"""Bounds of β, which the paper does not have. They limit sample weights to 20, and both parts of the mixture keep a positive
probability."""
LEAST_SHARE = 1e-4
"""Least part of the interval between a bound and β at the start. A bound itself has no logit."""


class BlendWeightMap(nn.Module):
    """β of every pixel: `β = 0.05 + 0.9 sigmoid(logit)`, 0.8 at the start (sections 5.1 and 6.1).

    A sample without radiance or outside the lens has the gradient 0. Adam's momentum may still change β in such a step, and
    in a pixel that has lost its candidates. β of a pixel that never had a candidate does not change. The logit and Adam's two
    moments take 12 bytes per pixel.

    pixels: number of pixels, H · W; start: β at the start; a bound stands for a β that is 9e-5 away.
    """

    def __init__(self, pixels: int, start: float = 0.8):
        super().__init__()
        share = min(max((start - MIN_BLEND) / (MAX_BLEND - MIN_BLEND), LEAST_SHARE), 1.0 - LEAST_SHARE)
        self.logit = nn.Parameter(torch.full((pixels,), math.log(share / (1.0 - share))))

    def forward(self, pixels: slice | Tensor = slice(None)) -> Tensor:
        """β of the given pixels, by default of all pixels, `[N]`."""
        # As a tanh, because the last bits of torch.sigmoid depend on the place in an array.
        return MIN_BLEND + (MAX_BLEND - MIN_BLEND) * (0.5 + 0.5 * torch.tanh(0.5 * self.logit[pixels]))

    @staticmethod
    def slope(beta: Tensor) -> Tensor:
        """∂β / ∂logit at given β, `[N]`."""
        return (beta - MIN_BLEND) * (MAX_BLEND - beta) / (MAX_BLEND - MIN_BLEND)
