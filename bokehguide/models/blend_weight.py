"""The blend between the projected Gaussians and the uniform lens (Eq. 26), learnt per pixel."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

LOWEST, HIGHEST = 0.05, 0.95


class BlendWeightMap(nn.Module):
    """β for every pixel: `β = 0.05 + 0.9 sigmoid(logit)`, starting at 0.8 (sections 5.1 and 6.1).

    The bounds keep the sample weights below 20 and leave both parts alive. The logit and
    Adam's two moments take 12 bytes a pixel. In a step whose sample brought no radiance, or
    fell outside the lens, a pixel's gradient is zero, which is its one-sample estimate;
    Adam's momentum may still move its β. A pixel that never had candidates never moves.

    pixels: number of pixels, H · W.
    """

    def __init__(self, pixels: int, start: float = 0.8):
        super().__init__()
        share = (start - LOWEST) / (HIGHEST - LOWEST)
        self.logit = nn.Parameter(torch.full((pixels,), math.log(share / (1.0 - share))))

    def forward(self, pixels: slice | Tensor = slice(None)) -> Tensor:
        """β of some pixels (all of them by default), `[N]`."""
        # The sigmoid as a tanh: PyTorch's own rounds otherwise at the end of an array, and so by where batches are cut.
        return LOWEST + (HIGHEST - LOWEST) * (0.5 + 0.5 * torch.tanh(0.5 * self.logit[pixels]))

    @staticmethod
    def slope(beta: Tensor) -> Tensor:
        """∂β / ∂logit at given β, `[N]`."""
        return (beta - LOWEST) * (HIGHEST - beta) / (HIGHEST - LOWEST)
