"""Learned numbers of light candidates at primary hits: a number for each tile of the frame.

Resampling keeps one of M light candidates. Their mean estimates the light without shadows, with a variance of a / M. More
candidates reduce this part of the variance alone, and each candidate costs time.

The two paths of a primary hit have independent candidates and lens points in common. Half the squared difference of their
estimates is a / M in the mean, and half the squared difference of their reflected radiances is a / M + r. The mean of two
paths has half this variance. The variance from hit to hit is not known, and counts as much. With a number N, the variance of a
hit's mean is therefore r + a / (2 M) + a / (2 N). The number

    M = COST / (1/2 + √(1/4 + 2 COST r / a))

is the N that minimises the product of this variance and the time, which is proportional to COST + N.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bokehguide.guiding.mis_factors import MAX_RADIANCE, finite
from bokehguide.render.vector import divisor
from bokehguide.runtime import native
from bokehguide.runtime.distributed import Ranks, RankSums

COST = 20.0
"""Time of a step without light candidates, over the time of one candidate at each path."""
MOST = 8
"""Largest number of light candidates."""


class CandidateCounts(RankSums):
    """Learns the number of light candidates of each tile. `add` takes the moments of a batch; `update` ends an epoch.

    sums: float64 `[2, tiles]`: Σ a and Σ r. count: numbers of the present epoch, whole, float32 `[tiles]`.
    """

    count: Tensor

    def __init__(self, tiles: int, first: int, device: torch.device, ranks: Ranks | None = None):
        super().__init__(torch.zeros(2, tiles, dtype=torch.float64, device=device), ranks)
        self.register_buffer("count", torch.full((tiles,), float(first), device=device))
        self._first = first

    def moments(self, owner: Tensor, tiles: Tensor, estimate: Tensor, reflected: Tensor) -> Tensor:
        """Sums `[2, tiles]` over pairs of paths.

        owner: primary hit of each path, int64 `[P]`, ascending. tiles: of the paths, int32 `[P]`. estimate: luminance of the mean
        of the candidates, `[P]`. reflected: luminance that the paths reflect, `[P]`.
        """
        found, core = torch.zeros_like(self.sums), native.core()
        if core is not None and found.device.type == "cpu":
            core.add_pair_moments(found, self.count, owner, tiles, estimate, reflected, MAX_RADIANCE)
            return found
        second = _odd(owner).double()
        of_candidates, whole = (0.5 * (finite(x) - finite(x.roll(1))).square() * second for x in (estimate, reflected))
        one = of_candidates * self.count.index_select(0, tiles)
        for total, values in zip(found, (one, whole - of_candidates)):
            total.index_add_(0, tiles, values)
        return found

    def add(self, moments: Tensor) -> None:
        """Add `moments` of a batch."""
        self.mine.add_(moments)

    def update(self, pooled: Callable[[Tensor], Tensor]) -> None:
        """Begin an epoch: compute the numbers from all merged pairs. pooled: averages `[tiles, 2]` over tiles."""
        one, rest = pooled(self.sums.T).T
        ratio = rest.clamp(min=0.0) / divisor(one, 1e-300)
        best = COST / (0.5 + (0.25 + 2.0 * COST * ratio).sqrt())
        self.count.copy_(torch.where(one > 0.0, best.round().clamp(1.0, MOST), float(self._first)))

    @property
    def sound(self) -> bool:
        """Whether a render can have these sums and numbers."""
        within = (self.count >= 1.0) & (self.count <= max(MOST, self._first)) & (self.count == self.count.round())
        return bool((self.sums.isfinite().all(0) & (self.sums[0] >= 0.0) & within).all())


def _odd(owner: Tensor) -> Tensor:
    """Whether each path is the second, the fourth, … of its primary hit, bool `[P]`."""
    number = torch.arange(len(owner), device=owner.device)
    starts = torch.ones_like(owner, dtype=torch.bool)
    starts[1:] = owner[1:] != owner[:-1]
    first = torch.where(starts, number, 0).cummax(0).values
    return (number - first) % 2 == 1
