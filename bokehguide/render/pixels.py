"""Which pixels of a frame a batch is made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.transfers import Coming

Pixels = slice | Tensor
"""Flat pixel indices: a slice `first:end` where they are consecutive, which makes views of a frame's
arrays, or int64 `[N]` in ascending order, which makes copies."""


def pixel_numbers(pixels: Pixels, device: torch.device | str = "cpu") -> Tensor:
    """The flat indices as int64 `[N]`; of a slice, which names its first and end."""
    return torch.arange(pixels.start, pixels.stop, device=device) if isinstance(pixels, slice) else pixels


def indices(mask: Tensor) -> Tensor:
    """The places, int64 `[K]`, at which `mask` `[N]` is true. On a CPU NumPy finds them in a quarter of PyTorch's time."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero()[:, 0]


def worthwhile(mask: Tensor) -> Tensor:
    """Places, int64 `[K]`, at which to work on what counts where `mask` `[N]` is true alone: those on a CPU. On other devices all places,
    as work in vain costs less there than the host's wait for how many there are."""
    return indices(mask) if mask.device.type == "cpu" else torch.arange(len(mask), device=mask.device)


class PlacesOfEach:
    """`indices` of some masks, of any sizes, which are asked for now and may be had later (see `Coming`)."""

    def __init__(self, masks: Sequence[Tensor]):
        self._masks, self._counts = masks, None
        if masks and masks[0].device.type != "cpu":
            self._counts = Coming(torch.stack([mask.sum() for mask in masks]))

    def get(self) -> list[Tensor]:
        """int64 `[K]` of each mask."""
        if self._counts is None:
            return [indices(mask) for mask in self._masks]
        return [_first_places(mask, count) for mask, count in zip(self._masks, self._counts.get().tolist())]


def indices_of_each(masks: Sequence[Tensor]) -> list[Tensor]:
    """`indices` of some masks, of any sizes; the host waits once for all of them."""
    return PlacesOfEach(masks).get()


def _first_places(mask: Tensor, count: int) -> Tensor:
    """The `count` places at which a mask is true, with no wait; the others are put behind, in one place."""
    place, number = torch.where(mask, mask.cumsum(0) - 1, count), torch.arange(len(mask), device=mask.device)
    return torch.empty(count + 1, dtype=torch.int64, device=mask.device).scatter_(0, place, number)[:count]


def parted(mask: Tensor) -> tuple[Tensor, Tensor]:
    """The places, int64, at which `mask` `[N]` is true, and those at which it is false; the host waits once for both."""
    true, false = indices_of_each((mask, ~mask))
    return true, false


def take(values: Tensor, pixels: Pixels) -> Tensor:
    """The entries `[.., N]` of `values` `[.., P]`; those of a slice are a view."""
    return values[..., pixels] if isinstance(pixels, slice) else values.index_select(-1, pixels)


def put(values: Tensor, pixels: Pixels, new: Tensor) -> None:
    """Replace entries of `values` `[.., P]` by `new` `[.., N]`; `index_copy_` would take twice as long."""
    if isinstance(pixels, slice):
        values[..., pixels] = new
    else:
        values.scatter_(-1, pixels.expand(*values.shape[:-1], new.shape[-1]), new)


def put_where(mask: Tensor, values: Tensor, places: Tensor, new: Tensor | float) -> None:
    """`put` where `mask` `[N]` is true alone (see `worthwhile`)."""
    put(values, places, torch.where(mask, new, values.index_select(-1, places)))


def increase(values: Tensor, pixels: Pixels, by: Tensor) -> None:
    """Add `by` `[.., N]` to entries of `values` `[.., P]`; `+=` would take twice as long, for pixels that are no slice four times."""
    if isinstance(pixels, slice):
        values[..., pixels].add_(by)
    else:
        values.index_add_(-1, pixels, by.to(values.dtype))


def box_pixels(box: tuple[int, int, int, int], width: int) -> Tensor:
    """Pixels of the box x, y, width, height in a frame `width` pixels wide, int64 `[N]`."""
    left, top, across, down = box
    return (torch.arange(top, top + down)[:, None] * width + torch.arange(left, left + across)).flatten()
