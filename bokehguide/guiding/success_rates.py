"""Success rates of draws: the contribution of each emitter's draws over the expected one, tile by tile of the frame.

The radiance and size of an emitter predict its contribution where nothing blocks the light. Draws of occluded emitters, or of
emitters that face away, fail. The share of failures is learned from the draws.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.random import hash_tensor
from bokehguide.runtime.compile.kernels import kernel
from bokehguide.runtime.distributed import Ranks, RankSums
from bokehguide.runtime.indexing import Pixels, pixel_numbers

TILE = 4
"""Pixels along the side of a tile."""
SLOTS_PER_PIXEL = 0.5
"""Slots of the table by pixel. Tiles and emitters that share a slot share a rate, which is no worse than no rate."""
PRIOR_DRAWS = 0.5
"""Successful draws of each emitter in each tile that are assumed in advance. The prior weighs less with more draws. A fixed prior
would draw a bright occluded emitter many times for each draw of a dim visible one."""
MAX_RATE = 5.0
"""Largest rate."""


class SuccessRates(RankSums):
    """Learns the root mean square of each emitter's contribution in each tile, over the expected contribution.

    `slots` names a tile and an emitter; `add` takes draws; `update` ends an epoch; an epoch uses `learned_scale`.
    sums: `[2, slots]`, of draws and of the squares of their contributions. emitters: number of emitters at the start of the
    field; other components have slot 0, of rate 1.
    """

    def __init__(self, camera: ThinLensCamera, emitters: int, ranks: Ranks | None = None):
        slots, device = 1 << max(int(SLOTS_PER_PIXEL * camera.width * camera.height) - 1, 1).bit_length(), camera.position.device
        super().__init__(torch.zeros(2, slots, dtype=torch.float64, device=device), ranks)
        self._width, self._bounds = camera.width, torch.tensor([[emitters], [slots - 1]], dtype=torch.int32, device=device)
        self.register_buffer("rates", torch.ones(slots, device=device))
        """The rates of the present epoch, by slot: a part of the state, as the sums hold draws of the epoch already."""

    def slots(self, pixels: Pixels, owner: Tensor, component: Tensor) -> Tensor:
        """Slots int32 `[M]` of components `[M]` of the field; owner: index into `pixels` of the pixel of each, `[M]`."""
        numbers = pixel_numbers(pixels, component.device).int()
        row = numbers // self._width
        tile = row // TILE * (-(-self._width // TILE)) + (numbers - row * self._width) // TILE
        return _slots(tile, owner, component, self._bounds)

    def add(self, slots: Tensor, squared: Tensor) -> None:
        """Add draws in slots `[K]`, and the squares of their contributions over the expected ones, `[K]`."""
        squared = squared.double()  # in single precision the sums would depend on the order of the batches
        self.mine[0].index_add_(0, slots, torch.ones_like(squared))
        self.mine[1].index_add_(0, slots, squared)

    def update(self) -> None:
        """Set the rates by all draws so far; collective."""
        self.merge()
        draws, squares = self.sums
        draws = draws + PRIOR_DRAWS
        self.rates = ((squares + PRIOR_DRAWS**2 / draws) / draws).sqrt().clamp(max=MAX_RATE).float()
        self.rates[0] = 1.0

    def learned_scale(self, slots: Tensor) -> Tensor:
        """Factors `[M]` for the weights of candidates in `slots` `[M]`."""
        return self.rates.index_select(0, slots)


@kernel
def _slots(tile: Tensor, owner: Tensor, component: Tensor, bounds: Tensor) -> Tensor:
    """`SuccessRates.slots` of pixels in tiles int32 `[N]`; bounds: number of emitters, and the last slot, int32 `[2, 1]`."""
    slot = hash_tensor(tile.index_select(0, owner) * 0x165667B1 + component.int() * 0x27D4EB2F) & bounds[1]
    return torch.where(component < bounds[0], slot.clamp(min=1), 0)
