"""Numbers of tiles of the frame, estimated from few samples with the help of the tiles around them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from bokehguide.render.vector import divisor
from bokehguide.runtime import native

OWN, POOLS = 0.5, ((3, 0.3), (7, 0.2))
"""Weight of a tile's own sum, and squares of tiles over which sums are averaged: tiles along the side, and weight."""
SQUARES = (31, 15, 7, 3, 1)
"""Tiles along the sides of the squares of `TilePools.shrunk`, from the largest square to the tile itself."""
SCALE_SQUARE = 3
"""As SQUARES, of the square whose second moments of all clusters are the unit of the moments of a tile."""
PRIOR_ARRIVALS = 1.0
"""Number of visible samples that the estimate of the next larger square counts as."""
DOUBT = 2.0
"""Number of expected visible samples at which PRIOR_ARRIVALS is halved, if none of them arrived."""
ESTIMATES = (0.7, 0.3)
"""Weights of the estimates of the tile and of the smallest square around the tile."""


class TilePools(NamedTuple):
    """A grid of tiles. Tables have a row for each tile, row by row of the frame: `[tiles, C]`."""

    across: int
    down: int

    def pooled(self, total: Tensor, threads: int = 1) -> Tensor:
        """A sum `[tiles, C]`, averaged over the squares around each tile, which are smaller at the edges of the frame."""
        core = native.core_on(total.device)
        if core is not None:
            tiles = self._table(total)
            core.pool_tiles(tiles, OWN, POOLS, pooled := torch.empty_like(tiles), threads)
            return pooled.view(total.shape)
        return OWN * total + sum(share * self._mean(total, width) for width, share in POOLS)

    def shrunk(self, moments: Tensor, arrived: Tensor, threads: int = 1) -> Tensor:
        """Estimated second moments of C clusters of lights, up to a factor for each tile, `[tiles, C]`.

        moments: sums of second moments, and arrived: numbers of visible samples, `[tiles, C]`.

        A tile has few samples of most clusters, and the tiles around it see nearly the same lights. The estimate of the largest
        square is therefore the prior of the next smaller square, and so on down to the tile itself (an empirical Bayes estimate,
        as of Efron and Morris 1973). A prior counts as PRIOR_ARRIVALS visible samples. The moments of a square count as the
        visible samples that its prior expects there, which do not depend on chance in the square. The estimate of a cluster that
        the square cannot see thus falls to zero. Where none of many expected samples arrived, the prior counts less.
        The moments are relative to those of all clusters around the tile, so that bright tiles do not outweigh others. The result
        is a weighted mean of the last two estimates.
        """
        scale = self._mean(moments.sum(1, keepdim=True), SCALE_SQUARE)
        relative = torch.where(scale > 0.0, moments / divisor(scale, 1e-300), 0.0)
        core = native.core_on(moments.device)
        if core is not None:
            values = self._table(relative)
            settings = SQUARES, PRIOR_ARRIVALS, DOUBT, ESTIMATES
            core.shrink_tiles(values, self._table(arrived), found := torch.empty_like(values), *settings, threads)
            return found.view(moments.shape)
        one = torch.ones_like(scale)
        estimates, expected = [self._mean(relative, SQUARES[0])], self._mean(arrived, SQUARES[0])
        for width in SQUARES[1:]:
            weight, numbers = expected * self._sum(one, width), self._mean(arrived, width)
            prior = PRIOR_ARRIVALS / torch.where(numbers > 0.0, 1.0, 1.0 + (weight / DOUBT) ** 2)
            estimates.append((prior * estimates[-1] + weight * self._mean(relative, width)) / (prior + weight))
            expected = (prior * expected + weight * numbers) / (prior + weight)
        return ESTIMATES[0] * estimates[-1] + ESTIMATES[1] * estimates[-2]

    def _mean(self, total: Tensor, width: int) -> Tensor:
        """Means over squares of `width` tiles along the side, `[tiles, C]`."""
        half, tiles = width // 2, self._table(total).permute(2, 0, 1)
        rows = avg_pool2d(tiles, (width, 1), 1, (half, 0), count_include_pad=False)
        mean = avg_pool2d(rows, (1, width), 1, (0, half), count_include_pad=False)
        return mean.permute(1, 2, 0).reshape(total.shape)

    def _sum(self, total: Tensor, width: int) -> Tensor:
        """As `_mean`, of sums."""
        found = avg_pool2d(self._table(total).permute(2, 0, 1), width, 1, width // 2, divisor_override=1)
        return found.permute(1, 2, 0).reshape(total.shape)

    def _table(self, total: Tensor) -> Tensor:
        """`[down, across, C]`, a copy where `total` is not contiguous."""
        return total.contiguous().view(self.down, self.across, -1)
