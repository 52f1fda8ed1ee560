"""Success rates: for each tile of the frame and each emitter, the contribution of draws over the expected contribution.

The radiance and the size of an emitter predict its contribution if nothing blocks the light. If a surface occludes the emitter,
or the emitter faces away, draws contribute nothing. The success rate corrects the prediction.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bokehguide.models.base import owners
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.random import hash_tensor
from bokehguide.runtime import native
from bokehguide.runtime.distributed import Ranks, RankSums
from bokehguide.runtime.indexing import Pixels, core_pixels, pixel_numbers

TILE = 4
"""Pixels along the side of a tile."""
SLOTS_PER_PIXEL = 0.5
"""Number of slots of the hash table per pixel. Pairs of tile and emitter may share a slot, and then share a rate."""
PRIOR_DRAWS = 0.5
"""Prior: number of successful draws of each emitter in each tile before the first draw. The weight of the prior decreases with
the number of draws. With a constant weight, tiles would draw a bright occluded emitter far more often than a dim visible
emitter."""
MAX_RATE = 5.0
"""Largest rate."""


class SuccessRates(RankSums):
    """Learns the root mean square of contribution over expected contribution, for each pair of tile and emitter.

    A pair has a slot in a hash table. `of_candidates` returns slots and the rates of the present epoch, `add` takes draws, and
    `update` ends an epoch.

    sums: number of draws, and sum of the squared ratios, `[2, slots]`. emitters: number of the scene's emitters, which are the
    first components of the field. All other components have slot 0 with the rate 1.
    """

    def __init__(self, camera: ThinLensCamera, emitters: int, ranks: Ranks | None = None):
        slots, device = 1 << max(int(SLOTS_PER_PIXEL * camera.width * camera.height) - 1, 1).bit_length(), camera.position.device
        super().__init__(torch.zeros(2, slots, dtype=torch.float64, device=device), ranks)
        self._width, self._emitters = camera.width, emitters
        self.register_buffer("rates", torch.ones(slots, device=device))
        """Rates of the present epoch, by slot. They are saved, because the sums already include draws of this epoch."""

    def of_candidates(self, pixels: Pixels, start: Tensor, component: Tensor) -> tuple[Tensor, Tensor]:
        """Slots int32 `[M]` and rates `[M]` of the candidates of pixels; start, component: see `CandidateList.batch`."""
        core = native.core_on(component.device)
        if core is not None:
            first, numbers = core_pixels(pixels)
            slots, rates = torch.empty(len(component), dtype=torch.int32), torch.empty(len(component))
            tiles = (self._width, TILE, -(-self._width // TILE), self._emitters)
            core.success_rates(tiles, self.rates, first, numbers, start.contiguous(), component.contiguous(), slots, rates)
            return slots, rates
        slots = self.slots(pixels, owners(start, len(component)), component)
        return slots, self.rates.index_select(0, slots)

    def slots(self, pixels: Pixels, owner: Tensor, component: Tensor) -> Tensor:
        """Slots int32 `[M]` of components `[M]` of the field, each for the pixel `pixels[owner]`; owner: `[M]`."""
        numbers = pixel_numbers(pixels, component.device).int()
        row = numbers // self._width
        tile = row // TILE * (-(-self._width // TILE)) + (numbers - row * self._width) // TILE
        slot = hash_tensor(tile.index_select(0, owner) * 0x165667B1 + component.int() * 0x27D4EB2F) & (len(self.rates) - 1)
        return torch.where(component < self._emitters, slot.clamp(min=1), 0)

    def add(self, batches: Sequence[tuple[Tensor, Tensor]], threads: int = 1) -> None:
        """Add draws with their slots, int32 `[K]`, and the squares `[K]` of contribution over expected contribution."""
        core = native.core_on(self.mine.device)
        if core is not None:
            core.add_draws(self.mine, [tuple(batch) for batch in batches], threads)
            return
        for slots, squared in batches:
            squared = squared.double()  # in single precision the sums would depend on the order of the batches
            self.mine[0].index_add_(0, slots, torch.ones_like(squared))
            self.mine[1].index_add_(0, slots, squared)

    def update(self) -> None:
        """Compute the rates from all draws so far; collective."""
        self.merge()
        draws, squares = self.sums
        draws = draws + PRIOR_DRAWS
        self.rates = ((squares + PRIOR_DRAWS**2 / draws) / draws).sqrt().clamp(max=MAX_RATE).float()
        self.rates[0] = 1.0
