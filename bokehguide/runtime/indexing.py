"""Gather from and scatter to the pixels of a frame or the entries of a batch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from bokehguide.runtime.device import HostCopy

Pixels = slice | Tensor
"""Flat pixel indices: a slice `first:end` of consecutive pixels, or ascending indices int64 `[N]`. A slice gives views of a
frame's arrays, and indices give copies."""


def pixel_numbers(pixels: Pixels, device: torch.device | str = "cpu") -> Tensor:
    """The flat indices as int64 `[N]`."""
    return torch.arange(pixels.start, pixels.stop, device=device) if isinstance(pixels, slice) else pixels


def core_pixels(pixels: Pixels) -> tuple[int, Tensor | None]:
    """The pixels as arguments of the native core: the first of consecutive pixels, or all indices."""
    return (pixels.start or 0, None) if isinstance(pixels, slice) else (0, pixels.contiguous())


def bands(pixels: int, size: int = 1 << 18) -> Iterator[slice]:
    """Slices of at most `size` of the pixels, in order: work on one after the other bounds the memory of its intermediates."""
    return (slice(first, min(first + size, pixels)) for first in range(0, pixels, size))


def indices(mask: Tensor) -> Tensor:
    """The indices, int64 `[K]`, at which `mask` `[N]` is true. On a CPU, NumPy needs a quarter of the time of PyTorch."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero()[:, 0]


class ActiveEntries:
    """K entries of a batch, which include the active entries: the entries at which `mask` `[N]` is true.

    On a CPU, the K entries are the active entries. On other devices, they are all N entries: the wait of the host for the number
    of active entries would cost more than the work on inactive entries. Values of inactive entries are undefined; `scatter` and
    `masked` discard these values. index: positions of the K entries in the batch, int64 `[K]`.
    """

    def __init__(self, mask: Tensor):
        if mask.device.type == "cpu":
            self.index, self._mask = indices(mask), None
        else:
            self.index, self._mask = torch.arange(len(mask), device=mask.device), mask

    def __len__(self) -> int:
        return len(self.index)

    def select(self, values: Tensor) -> Tensor:
        """The K entries of `values` `[.., N]`."""
        return values.index_select(-1, self.index)

    def masked(self, selected: Tensor, default: float) -> Tensor:
        """`selected` `[.., K]`, with `default` at inactive entries."""
        return selected if self._mask is None else torch.where(self._mask, selected, default)

    def scatter(self, values: Tensor, selected: Tensor | float) -> None:
        """Replace the active entries of `values` `[.., N]` by `selected` `[.., K]`."""
        if self._mask is not None:
            values.copy_(torch.where(self._mask, selected, values))
        elif isinstance(selected, Tensor):
            scatter(values, self.index, selected)
        else:
            values.index_fill_(-1, self.index, selected)


class PendingIndices:
    """`indices` of several masks of any sizes. The host waits for the numbers of indices only in `get` (see `HostCopy`)."""

    def __init__(self, masks: Sequence[Tensor]):
        self._masks, self._counts = masks, None
        if masks and masks[0].device.type != "cpu":
            self._counts = HostCopy(torch.stack([mask.sum() for mask in masks]))

    def get(self) -> list[Tensor]:
        """int64 `[K]` of each mask."""
        if self._counts is None:
            return [indices(mask) for mask in self._masks]
        return [_first_indices(mask, count) for mask, count in zip(self._masks, self._counts.get().tolist())]


def indices_of_each(masks: Sequence[Tensor]) -> list[Tensor]:
    """`indices` of several masks of any sizes; the host waits once for all."""
    return PendingIndices(masks).get()


def _first_indices(mask: Tensor, count: int) -> Tensor:
    """The `count` indices at which a mask is true, without a wait of the host. An extra last entry collects all other indices."""
    place, number = torch.where(mask, mask.cumsum(0) - 1, count), torch.arange(len(mask), device=mask.device)
    return torch.empty(count + 1, dtype=torch.int64, device=mask.device).scatter_(0, place, number)[:count]


def partition_indices(mask: Tensor) -> tuple[Tensor, Tensor]:
    """The indices, int64, at which `mask` `[N]` is true and at which it is false; the host waits once for both."""
    true, false = indices_of_each((mask, ~mask))
    return true, false


def gather_pixels(values: Tensor, pixels: Pixels) -> Tensor:
    """The entries `[.., N]` of `values` `[.., P]`, a view if `pixels` is a slice."""
    return values[..., pixels] if isinstance(pixels, slice) else values.index_select(-1, pixels)


def scatter(values: Tensor, pixels: Pixels, new: Tensor) -> None:
    """Replace entries of `values` `[.., P]` by `new` `[.., N]`. `index_copy_` would take twice as long."""
    if isinstance(pixels, slice):
        values[..., pixels] = new
    else:
        values.scatter_(-1, pixels.expand(*values.shape[:-1], new.shape[-1]), new)


def scatter_add(values: Tensor, pixels: Pixels, by: Tensor) -> None:
    """Add `by` `[.., N]` to entries of `values` `[.., P]`. `+=` would take twice as long on a slice, four times on indices."""
    if isinstance(pixels, slice):
        values[..., pixels].add_(by)
    else:
        values.index_add_(-1, pixels, by.to(values.dtype))


def box_pixels(box: tuple[int, int, int, int], width: int) -> Tensor:
    """Pixels of a box (x, y, width, height) in a frame `width` pixels wide, int64 `[N]`."""
    left, top, columns, rows = box
    return (torch.arange(top, top + rows)[:, None] * width + torch.arange(left, left + columns)).flatten()
