"""Cross-fitting: coefficients of the control variate for the first step, which has no earlier epochs.

A coefficient from a pixel's own sample would bias the picture. In the first step, nothing is learned, so that the samples of
different groups of pixels are independent (see `PixelGroups`). The coefficient of a group therefore comes from the samples of
the other groups around it (cross-fitting, as of Chernozhukov et al. 2018).

The slope of radiance on weight is that of the near tiles in the same band of rows, without the group itself. Where the other
group of the tile is darker than these tiles, the coefficient is smaller in proportion. Pixels more than a tile away from any
light therefore stay exactly dark. The light groups have their shares of the correction from the same samples.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.guiding.control_variate import summands, trusted_slopes
from bokehguide.guiding.native_reuse import PixelGroups
from bokehguide.render.vector import luminance
from bokehguide.runtime.distributed import ROWS_PER_BAND
from bokehguide.runtime.indexing import Pixels, pixel_numbers

REACH = 8
"""Distance, in pixels along the band, up to which tiles count."""
DEPENDENCE = 4.0
"""Factor of the squared standard error of a slope: the samples of a group are correlated, and tell less than independent ones."""


class _Places(NamedTuple):
    """Places of N pixels: numbers of their groups among `shape` = (bands, rows of tiles, tiles, 2 groups), int64 `[N]`."""

    group: Tensor
    shape: tuple[int, int, int, int]

    @classmethod
    def of(cls, places: Pixels, groups: PixelGroups, device: torch.device) -> _Places:
        numbers = pixel_numbers(places, device)
        row, x = numbers // groups.width, numbers % groups.width + groups.right
        first = places.start if isinstance(places, slice) else int(numbers[0])
        last = places.stop - 1 if isinstance(places, slice) else int(numbers[-1])
        rows = ROWS_PER_BAND * groups.width
        band, y = row // ROWS_PER_BAND - first // rows, row % ROWS_PER_BAND + groups.below
        down = (ROWS_PER_BAND - 1 + groups.below) // groups.down + 1
        across = (groups.width - 1 + groups.right) // groups.across + 1
        shape = (last // rows - first // rows + 1, down, across, 2)
        tile = (band * down + y // groups.down) * across + x // groups.across
        return cls(2 * tile + _parity((y % groups.down * groups.across + x % groups.across) & groups.mask), shape)

    def sums(self, values: Tensor) -> Tensor:
        """Sums `[R, *shape]` over groups of `values` `[R, N]`."""
        count = self.shape[0] * self.shape[1] * self.shape[2] * 2
        return values.new_zeros(len(values), count).index_add_(1, self.group, values).reshape(len(values), *self.shape)

    def at(self, values: Tensor) -> Tensor:
        """Values `[R, *shape]` of groups at the pixels, `[R, N]`."""
        return values.flatten(1).index_select(1, self.group)


def cross_fitted(
    places: Pixels, groups: PixelGroups, radiance: Tensor, weight: Tensor, shrinkage: float, by_light: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Coefficients `[3, N]` of the control variate in the first step, and shares of L light groups in them, `[L, 3, N]`.

    places: pixels of whole bands of rows. groups: of the step. radiance, weight: of the samples after reuse, `[3, N]` and `[N]`.
    shrinkage: as of `ControlVariate`. by_light: radiance of the light groups, `[L, 3, N]`, None for no light groups.
    """
    at = _Places.of(places, groups, weight.device)
    sums = at.sums(summands(radiance, weight))
    others = _without_own(sums, REACH // groups.across)
    slope, color = trusted_slopes(others, DEPENDENCE * shrinkage)
    light = luminance(color).clamp(min=0.0)
    coefficient = slope.clamp(-light, light) * color / light.clamp(min=1e-300)
    beside = sums.flip(-1)  # of the other group of the tile
    share = beside[5:] / beside[0].clamp(min=1.0) / color.clamp(min=1e-300)
    coefficient = coefficient * share.clamp(0.0, 1.0)
    if by_light is None:
        return at.at(coefficient).to(radiance.dtype), radiance.new_zeros(0, *radiance.shape)
    finite = (weight + luminance(radiance)).isfinite()
    parts = at.sums(torch.where(finite, by_light, 0.0).double().nan_to_num(0.0, 0.0, 0.0).clamp(min=0.0).flatten(0, 1))
    parts = at.at(_without_own(parts, REACH // groups.across)).reshape(by_light.shape)
    total = parts.sum(0)
    shares = torch.where(total > 0.0, parts / total.clamp(min=1e-300), 1.0 / len(parts))
    return at.at(coefficient).to(radiance.dtype), shares.to(radiance.dtype)


def _without_own(sums: Tensor, reach: int) -> Tensor:
    """Sums `[R, bands, rows, tiles, 2]` over the tiles of the band that are at most `reach` tiles away, without the own group."""
    bands = sums.sum((2, 4))
    near = torch.zeros_like(bands)
    for shift in range(-reach, reach + 1):
        from_here, to_here = (
            slice(max(0, -shift), bands.shape[-1] - max(0, shift)),
            slice(max(0, shift), bands.shape[-1] - max(0, -shift)),
        )
        near[..., to_here] += bands[..., from_here]
    return near[:, :, None, :, None] - sums


def _parity(bits: Tensor) -> Tensor:
    """Parity of the bits of numbers below 2^8."""
    for shift in (4, 2, 1):
        bits = bits ^ (bits >> shift)
    return bits & 1
