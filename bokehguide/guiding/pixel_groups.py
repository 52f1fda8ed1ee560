"""The groups of neighbouring pixels that reuse each other's primary hits.

The pixels of a tile of the film form two groups. The positions of tiles change with every epoch. In a picture of few samples,
compact groups would show as blocks. The groups of the first SCATTERED_STEPS steps are therefore scattered, in a pattern like a
chessboard. Their tiles have ragged edges, because straight edges would show as lines. The groups of later steps are compact,
because near pixels see more of each other's hits. No group crosses the end of a band of rows or columns, so that ranks, batches
and blocks of adaptive SPP contain whole groups.

The pixels of a group use the same hits. The hits of all pixels together must therefore cover the lens evenly. Within an epoch,
the lens points of a group are parts of one sequence (`PixelRandom.in_groups`).
"""

from __future__ import annotations

from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.random import hash_int
from bokehguide.runtime import native
from bokehguide.runtime.device import to_device
from bokehguide.runtime.distributed import ROWS_PER_BAND
from bokehguide.runtime.indexing import Pixels, core_pixels, pixel_numbers

COLUMNS = 32
"""Number of columns in a band. Groups end at the end of a band."""
SCATTERED_STEPS = 32
"""Number of steps with scattered groups: the last step of an epoch."""


class PixelGroups(NamedTuple):
    """Groups of neighbouring pixels on a film of this `width`: the pixels of a tile form two groups.

    A tile has `across` x `down` pixels, both powers of two. Tiles are shifted vertically by `below`, and horizontally by an entry
    of `right` for each row of a band. All lengths are in pixels.
    `mask` selects bits of a pixel's number in its tile. The parity of the selected bits is the group. With the highest bit of the
    longer side alone, the groups are the two halves of the tile. With the lowest bits of both sides and random others, most
    adjacent pixels are in different groups, in a pattern like a chessboard.
    """

    width: int
    across: int
    down: int
    right: tuple[int, ...]
    below: int
    mask: int

    @staticmethod
    def of(width: int, size: int, key: int, scattered: bool) -> PixelGroups:
        """Groups of an epoch. size: number of pixels of a group, a power of two. key: random bits that turn and shift the
        tiles, and choose the pattern of `scattered` groups; other groups are halves of tiles."""
        bits = size.bit_length()
        sides = 1 << -(-bits // 2), 1 << bits // 2  # of 2 size pixels
        across, down = sides if key & 1 else sides[::-1]
        if scattered:
            below = (key >> 16) % down if down < ROWS_PER_BAND else 0  # a band contains whole tiles
            mask = (key >> 24) % (2 * size) | (across > 1) | across * (down > 1)
        else:
            below = (key >> 16) % min(sides)
            mask = across // 2 if key & 1 else size
        # Even steps from row to row keep the pattern like a chessboard.
        steps = (2 * (hash_int(key + row) & 1) if scattered else 0 for row in range(ROWS_PER_BAND))
        return PixelGroups(width, across, down, tuple((key >> 8) % across + step for step in steps), below, mask)

    def offsets(self) -> list[tuple[int, int]]:
        """Members of a group, as (x, y) to combine with the place of a pixel in its tile by exclusive or. The first member is
        the pixel itself."""
        places = range(self.across * self.down)
        return [(at % self.across, at // self.across) for at in places if (at & self.mask).bit_count() % 2 == 0]

    @property
    def tiles_across(self) -> int:
        """Number of tiles across the film."""
        return (self.width - 1 + max(self.right)) // self.across + 1

    def columns(self, x: Tensor, line: Tensor) -> Tensor:
        """Columns of N pixels from the first tile on, `[N]`. x, line: pixels of the film, int32 or int64 `[N]`."""
        return x + to_device(list(self.right), x.device, x.dtype).index_select(0, line % ROWS_PER_BAND)

    def numbered(self, places: Pixels, device: torch.device | str) -> tuple[Tensor, Tensor]:
        """Number of the group of each of N pixels of the film, and number of the pixel in the group, int32 `[N]` each."""
        core = native.core_on(torch.device(device))
        if core is not None:
            return self._numbered_by_core(core, places)
        pixels = pixel_numbers(places, device).to(torch.int32)
        line, x = pixels // self.width, pixels % self.width
        column, row = self.columns(x, line), line % ROWS_PER_BAND + self.below
        at = (row % self.down) * self.across + column % self.across
        parity = torch.zeros_like(at)
        for bit in range(self.mask.bit_length()):
            parity ^= (at & self.mask) >> bit & 1
        rows, columns = -(-(ROWS_PER_BAND + self.below) // self.down), self.tiles_across
        tile = (line // ROWS_PER_BAND * rows + row // self.down) * columns + column // self.across
        # The highest selected bit follows from the parity. A tile lies in at most two bands of columns.
        highest = self.mask.bit_length() - 1
        return 4 * tile + 2 * (x // COLUMNS % 2) + parity, at & ((1 << highest) - 1) | at >> (highest + 1) << highest

    def _numbered_by_core(self, core: ModuleType, places: Pixels) -> tuple[Tensor, Tensor]:
        """`numbered` by the native core."""
        count = places.stop - (places.start or 0) if isinstance(places, slice) else len(places)
        group, member = torch.empty(2, count, dtype=torch.int32)
        lengths = self.width, self.across, self.down, self.below, self.mask, self.tiles_across
        core.number_groups(lengths, torch.tensor(self.right, dtype=torch.int32), *core_pixels(places), group, member)
        return group, member

    def members(self, places: Pixels, device: torch.device) -> Tensor:
        """The other pixels in the groups of N pixels, as indices into the N pixels, int64 `[members - 1, N]`; -1 for no pixel.

        places: pixels of the film.
        """
        numbers = pixel_numbers(places, device)
        first, last = (places.start, places.stop - 1) if isinstance(places, slice) else (int(places[0]), int(places[-1]))
        among = torch.full((last - first + 2,), -1, device=device)  # the last entry is shared by all other places
        among[numbers - first] = torch.arange(len(numbers), device=device)
        there = numbers - first + self._steps(device).index_select(1, numbers % (ROWS_PER_BAND * self.width))
        there = torch.where((there >= 0) & (there < len(among)), there, len(among) - 1)
        return among.index_select(0, there.flatten()).reshape(there.shape)

    def _steps(self, device: torch.device) -> Tensor:
        """Offsets in pixel numbers from each pixel of a band to the other pixels of its group, int64
        `[members - 1, ROWS_PER_BAND * width]`. If the other pixel is outside the band, the offset leads outside any film."""
        width, (dx, dy) = self.width, to_device(list(zip(*self.offsets())), device, torch.int64)[:, :, None, None]
        row, x = torch.meshgrid(*(torch.arange(size, device=device) for size in (ROWS_PER_BAND, width)), indexing="ij")
        line = ((row + self.below) ^ dy) - self.below
        right = to_device(list(self.right), device, torch.int64)
        column = ((x + right[row]) ^ dx) - right[line % ROWS_PER_BAND]
        inside = (column < width) & (column // COLUMNS == x // COLUMNS) & (line >= 0) & (line < ROWS_PER_BAND)
        return torch.where(inside, (line - row) * width + column - x, -(1 << 40))[1:].flatten(1)
