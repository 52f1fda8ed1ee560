"""What drawing each lamp of the field brought, tile by tile of the frame.

How bright a lamp is and how large it looks says what it would bring if nothing stood before it. Lamps behind a house, or
that face away, are drawn in vain; how often, only draws can tell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import Pixels, pixel_numbers
from bokehguide.render.random import hash_tensor
from bokehguide.train.rank_sums import RankSums
from bokehguide.train.ranks import Ranks

TILE = 4
"""Pixels along the side of a tile."""
SLOTS_PER_PIXEL = 0.5
"""Slots of the table. Tiles and lamps that fall on one slot are taken for one, which makes draws no worse than unlearnt."""
DRAWS_BEFORE = 0.5
"""Draws of each lamp in each tile that are taken to have brought what they might. The more draws there are, the less that is
believed, or a bright lamp behind a house would be drawn again and again before the dim window beside it."""
HIGHEST = 5.0
"""Most that a lamp's draws may count, in units of what they might bring."""


class LampYield(RankSums):
    """Learns the root mean square of what draws of each lamp bring in each tile, over what they might bring.

    `slots` names a tile and a lamp; `add` takes draws; `update` ends a block; `factor` is what the block goes by.
    sums: `[2, slots]`, of draws and of the squares of what they brought. lamps: how many there are; what else is in the
    field is not learnt about, and has slot 0.
    """

    def __init__(self, camera: ThinLensCamera, lamps: int, ranks: Ranks | None = None):
        slots, device = 1 << max(int(SLOTS_PER_PIXEL * camera.width * camera.height) - 1, 1).bit_length(), camera.position.device
        super().__init__(torch.zeros(2, slots, dtype=torch.float64, device=device), ranks)
        self._width, self._bounds = camera.width, torch.tensor([[lamps], [slots - 1]], dtype=torch.int32, device=device)
        self.register_buffer("learnt", torch.ones(slots, device=device))
        """What the block goes by, of each slot: part of the state, as draws of the block are in the sums already."""

    def slots(self, pixels: Pixels, owner: Tensor, lamp: Tensor) -> Tensor:
        """Slots int32 `[M]` of lamps `[M]` of the field as pixels see them; owner `[M]`: whose they are of `pixels`."""
        numbers = pixel_numbers(pixels, lamp.device).int()
        row = numbers // self._width
        tile = row // TILE * (-(-self._width // TILE)) + (numbers - row * self._width) // TILE
        return _slots(tile, owner, lamp, self._bounds)

    def add(self, slots: Tensor, squared: Tensor) -> None:
        """Add draws `[K]`, and the squares of what they brought in units of what they might have."""
        squared = squared.double()  # or sums would depend on who adds first, and with them what is drawn
        self.mine[0].index_add_(0, slots, torch.ones_like(squared))
        self.mine[1].index_add_(0, slots, squared)

    def update(self) -> None:
        """Go by all draws so far; collective."""
        self.merge()
        draws, squares = self.sums
        whole = draws + DRAWS_BEFORE
        self.learnt = ((squares + DRAWS_BEFORE**2 / whole) / whole).sqrt().clamp(max=HIGHEST).float()
        self.learnt[0] = 1.0

    def factor(self, slots: Tensor) -> Tensor:
        """What weights of candidates in `slots` `[M]` are to be multiplied by."""
        return self.learnt.index_select(0, slots)


@kernel
def _slots(tile: Tensor, owner: Tensor, lamp: Tensor, bounds: Tensor) -> Tensor:
    """`LampYield.slots` of pixels in tiles int32 `[N]`; bounds: number of lamps, and the last slot, int32 `[2, 1]`."""
    slot = hash_tensor(tile.index_select(0, owner) * 0x165667B1 + lamp.int() * 0x27D4EB2F) & bounds[1]
    return torch.where(lamp < bounds[0], slot.clamp(min=1), 0)
