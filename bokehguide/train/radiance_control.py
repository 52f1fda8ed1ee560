"""The weights of lens samples as a control variate for the radiance.

Weights W / (A q) have the mean 1, whatever is seen. Where what is seen is even, all noise is in them, and radiance less
c (weight - 1) has none of it; where highlights are guided to, weights say little. How much they say, c, is the slope of a
regression over earlier blocks of steps: a c from the same block would make the picture biased. Where an edge goes through a
cell, that is wrong for some of its pixels: no |c| is larger than what the pixel itself saw on average in those blocks. So what is
dark stays so exactly, and no mean comes out negative where the mean weight stays below 2.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad, unfold

from bokehguide.render.pixels import Pixels, pixel_numbers, take
from bokehguide.render.vector import luminance
from bokehguide.train.rank_sums import RankSums
from bokehguide.train.ranks import BAND, Ranks

CELL = 4
"""Pixels along the side of the squares that have a slope of their own; bands hold whole ones."""
DOUBT = 64.0
"""A slope counts for the less, the larger this many squared standard errors of it are beside its square: those of
samples that pixels do not share."""
EVENEST = 1e-3
"""Variance of weights below which there is nothing to control."""


class RadianceControl(RankSums):
    """Learns slopes for a film of some width and height, cell by cell.

    `add` takes samples, `update` ends a block, `slope` is what the block goes by. sums: `[8, cells]`, of samples, weights
    w, w², w v, v², and v in its three channels, with v the radiance, in w v and v² its luminance.
    """

    def __init__(self, width: int, height: int, device: torch.device, ranks: Ranks | None = None):
        assert BAND % CELL == 0
        self._width, self._across = width, -(-width // CELL)
        cells = self._across * -(-height // CELL)
        super().__init__(torch.zeros(8, cells, dtype=torch.float64, device=device), ranks)
        self.register_buffer("slopes", torch.zeros(3, cells, device=device))
        self.register_buffer("most", torch.zeros(3, width * height, device=device))
        """What |c| may be in each pixel."""

    def _cells(self, places: Pixels) -> Tensor:
        numbers = pixel_numbers(places, self.slopes.device)
        return numbers // self._width // CELL * self._across + numbers % self._width // CELL

    def slope(self, places: Pixels) -> Tensor:
        """c `[3, N]` of some pixels of the film, 0 in the first block."""
        most = take(self.most, places)
        return self.slopes.index_select(1, self._cells(places)).clamp(-most, most)

    def add(self, places: Pixels, radiance: Tensor, weight: Tensor) -> None:
        """Add samples `[3, N]` with their weights `[N]`. Those that are not finite count for none."""
        radiance, weight = radiance.double(), weight.double()  # squares of large float32 are none
        light = luminance(radiance)
        rows = torch.stack((torch.ones_like(light), weight, weight * weight, weight * light, light * light, *radiance))
        rows *= (weight + light).isfinite()
        self.mine.index_add_(1, self._cells(places), rows.nan_to_num(0.0, 0.0, 0.0))

    def update(self, picture: Tensor) -> None:
        """End a block: go by all samples so far; collective. picture: `[3, pixels]` so far, 0 but in this rank's pixels."""
        self.merge()
        self.most.copy_(self.ranks.total(picture).clamp(min=0.0))
        count, weight, squares, product, light_squares = self.sums[:5]
        count = count.clamp(min=1.0)
        color = self.sums[5:] / count
        light = luminance(color)
        spread = squares / count - (weight / count).square()
        shared = product / count - light * weight / count
        slope = shared / spread.clamp(min=EVENEST)
        error = (light_squares / count - light * light - shared * slope).clamp(min=0.0) / (spread.clamp(min=EVENEST) * count)
        trust = slope * slope / (slope * slope + DOUBT * error).clamp(min=1e-300)
        self.slopes.copy_(self._median(slope * trust) * color / light.clamp(min=1e-300))

    def _median(self, values: Tensor) -> Tensor:
        """Of each cell and those around it, `[cells]`."""
        image = pad(values.reshape(1, 1, -1, self._across), (1, 1, 1, 1), mode="replicate")
        return unfold(image, 3)[0].median(0).values
