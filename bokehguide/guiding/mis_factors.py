"""Learned MIS weights at primary hits: a factor for each tile of the frame.

The shadow ray of a light sample and the BSDF sample that continues the path both find light that comes from many directions. The
power heuristic ignores the visibility, and ignores that a BSDF sample which misses the light finds a surface. The better weights
therefore differ from place to place. Lights in few directions, which BSDF samples rarely find, keep the power heuristic.

With the factor θ, the radiance that a path reflects is X = U + θ D. D is the broad light that the shadow ray finds, minus the
broad light that the BSDF sample finds, each with the weight that θ multiplies (`mis.BsdfWeights`). The expected value of D is 0,
so that the mean of X does not depend on θ. The factor θ = -E[U D] / E[D²] minimises the variance, as do the optimal weights of
Kondapaneni et al. 2019.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bokehguide.render.vector import divisor
from bokehguide.runtime import native
from bokehguide.runtime.distributed import Ranks, RankSums

MIN_FACTOR = 0.05
"""Smallest factor, so that light samples keep a positive weight and the factor can rise again."""
STEPS = 1000
"""Factors are multiples of 1 / STEPS, so that the order of the sums does not change them."""
MAX_RADIANCE = 1e30
"""Radiance in learning is clamped to this value, so that sums of squares stay finite."""


class MisFactors(RankSums):
    """Learns the factor of each tile. `add` takes the moments of a batch; `update` ends an epoch.

    sums: float64 `[2, tiles]`: Σ U D and Σ D². factor: of the present epoch, float32 `[tiles]`.
    """

    factor: Tensor

    def __init__(self, tiles: int, device: torch.device, ranks: Ranks | None):
        super().__init__(torch.zeros(2, tiles, dtype=torch.float64, device=device), ranks)
        self.register_buffer("factor", torch.ones(tiles, device=device))

    def moments(self, tiles: Tensor, difference: Tensor, reflected: Tensor) -> Tensor:
        """Sums `[2, tiles]` over paths: tile, int32, luminance of D and luminance of X, `[P]` each."""
        found, core = torch.zeros_like(self.sums), native.core_on(self.sums.device)
        if core is not None:
            core.add_mis_moments(found, self.factor, tiles, difference, reflected, MAX_RADIANCE)
            return found
        change, light = (_finite(values) for values in (difference, reflected))
        rest = light - self.factor.double().index_select(0, tiles) * change
        for total, values in zip(found, (rest * change, change * change)):
            total.index_add_(0, tiles, values)
        return found

    def add(self, moments: Tensor) -> None:
        """Add the `moments` of a batch."""
        self.mine.add_(moments)

    def update(self, pooled: Callable[[Tensor], Tensor]) -> None:
        """Begin an epoch: compute the factors from all merged paths. pooled: averages `[tiles, 2]` over tiles."""
        product, square = pooled(self.sums.T).T
        found = torch.where(square > 0.0, -product / divisor(square, 1e-300), 1.0)
        self.factor.copy_((found.clamp(MIN_FACTOR, 1.0) * STEPS).round() / STEPS)

    @property
    def sound(self) -> bool:
        """Whether a render can have these sums and factors."""
        within = (self.factor >= MIN_FACTOR * (1.0 - 1e-6)) & (self.factor <= 1.0)
        return bool((self.sums.isfinite().all(0) & within).all())


def _finite(light: Tensor) -> Tensor:
    """Luminance `[P]` in double precision, 0 for NaN."""
    return light.double().nan_to_num(0.0, MAX_RADIANCE, -MAX_RADIANCE).clamp(-MAX_RADIANCE, MAX_RADIANCE)
