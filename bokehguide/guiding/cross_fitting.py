"""Cross-fitting: coefficients of the control variate for the first step, which has no earlier epochs.

A coefficient from a pixel's own sample would bias the picture. In the first step, nothing is learned, so that the samples of
different groups of pixels are independent (see `PixelGroups`). The coefficient of a group therefore comes from the samples of
the other groups around it (cross-fitting, as of Chernozhukov et al. 2018).

The slope of radiance on weight is that of the near tiles in the same band of rows, without the group itself. The coefficient is
0 unless the weights explain much of the noise there. The coefficient is at most the lower quartile of radiance / weight in the
other group of the tile. Few pixels are therefore negative, and pixels more than a tile away from any light stay exactly dark. The
light groups have their shares of the correction from the near tiles as well.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from bokehguide.guiding.control_variate import Regressions, summands
from bokehguide.guiding.pixel_groups import PixelGroups
from bokehguide.render.vector import luminance
from bokehguide.runtime.distributed import ROWS_PER_BAND
from bokehguide.runtime.indexing import Pixels, pixel_numbers

REACH = 8
"""Distance, in pixels along the band, up to which tiles count."""
LEAST_EXPLAINED = 0.4
"""Least share of the variance of the luminance that the weights explain, where the coefficient is not 0."""


class _Places(NamedTuple):
    """Places of N pixels: numbers of their groups among `shape` = (bands, rows of tiles, tiles, 2 groups), int64 `[N]`."""

    group: Tensor
    shape: tuple[int, int, int, int]

    @classmethod
    def of(cls, places: Pixels, groups: PixelGroups, device: torch.device) -> _Places:
        numbers = pixel_numbers(places, device)
        row = numbers // groups.width
        x = groups.columns(numbers % groups.width, row)
        first = places.start if isinstance(places, slice) else int(numbers[0])
        last = places.stop - 1 if isinstance(places, slice) else int(numbers[-1])
        rows = ROWS_PER_BAND * groups.width
        band, y = row // ROWS_PER_BAND - first // rows, row % ROWS_PER_BAND + groups.below
        down = (ROWS_PER_BAND - 1 + groups.below) // groups.down + 1
        shape = (last // rows - first // rows + 1, down, groups.tiles_across, 2)
        tile = (band * down + y // groups.down) * groups.tiles_across + x // groups.across
        return cls(2 * tile + _parity((y % groups.down * groups.across + x % groups.across) & groups.mask), shape)

    def sums(self, values: Tensor) -> Tensor:
        """Sums `[R, *shape]` over groups of `values` `[R, N]`."""
        count = self.shape[0] * self.shape[1] * self.shape[2] * 2
        return values.new_zeros(len(values), count).index_add_(1, self.group, values).reshape(len(values), *self.shape)

    def at(self, values: Tensor) -> Tensor:
        """Values `[R, *shape]` of groups at the pixels, `[R, N]`."""
        return values.flatten(1).index_select(1, self.group)

    def lower_quartiles(self, values: Tensor) -> Tensor:
        """Lower quartiles `[*shape]` of the values `[N]` of each group; 0 for groups without a pixel."""
        order = values.argsort()
        order = order.index_select(0, self.group.index_select(0, order).argsort(stable=True))
        count = torch.bincount(self.group, minlength=math.prod(self.shape))
        place = (count.cumsum(0) - count + count // 4).clamp(max=len(values) - 1)
        found = values.index_select(0, order.index_select(0, place))
        return torch.where(count > 0, found, 0.0).reshape(self.shape)


def cross_fitted(
    places: Pixels, groups: PixelGroups, radiance: Tensor, weight: Tensor, by_light: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Coefficients `[3, N]` of the control variate in the first step, and shares of L light groups in them, `[L, 3, N]`.

    places: pixels of whole bands of rows. groups: of the step. radiance, weight: of the samples after reuse, `[3, N]` and `[N]`.
    by_light: radiance of the light groups, `[L, 3, N]`, None for no light groups.
    """
    at, reach = _Places.of(places, groups, weight.device), REACH // groups.across
    rows = summands(radiance, weight)
    slope, _, explained, color = Regressions.of(_without_own(at.sums(rows), reach))
    level = luminance(rows[5:]) / rows[1].clamp(min=1.0)
    most = at.lower_quartiles(level).flip(-1)  # of the other group of the tile
    slope = torch.minimum(slope, most).clamp(min=0.0) * (explained > LEAST_EXPLAINED)
    coefficient = at.at(slope * color / luminance(color).clamp(min=1e-300)).to(radiance.dtype)
    if by_light is None:
        return coefficient, radiance.new_zeros(0, *radiance.shape)
    light = torch.where(rows[0] > 0.0, by_light, 0.0).double().clamp(min=0.0).flatten(0, 1)
    parts = at.at(_without_own(at.sums(light), reach)).reshape(by_light.shape)
    total = parts.sum(0)
    shares = torch.where(total > 0.0, parts / total.clamp(min=1e-300), 1.0 / len(parts))
    return coefficient, shares.to(radiance.dtype)


def _without_own(sums: Tensor, reach: int) -> Tensor:
    """Sums `[R, bands, rows, tiles, 2]` over the tiles of the band that are at most `reach` tiles away, without the own group.

    The own group is left out, and not subtracted: the difference from a large sum would have its rounding errors.
    """
    columns = sums.sum((2, 4))
    beside = torch.zeros_like(columns)
    for shift in (*range(-reach, 0), *range(1, reach + 1)):
        from_here, to_here = (
            slice(max(0, -shift), columns.shape[-1] - max(0, shift)),
            slice(max(0, shift), columns.shape[-1] - max(0, -shift)),
        )
        beside[..., to_here] += columns[..., from_here]
    of_column = sums.transpose(2, 3).flatten(3)
    before = pad(of_column, (1, 0)).cumsum(-1)[..., :-1]
    after = pad(of_column, (0, 1)).flip(-1).cumsum(-1).flip(-1)[..., 1:]
    others = (before + after).unflatten(-1, (-1, 2)).transpose(2, 3)
    return others + beside[:, :, None, :, None]


def _parity(bits: Tensor) -> Tensor:
    """Parity of the bits of numbers below 2^8."""
    for shift in (4, 2, 1):
        bits = bits ^ (bits >> shift)
    return bits & 1
