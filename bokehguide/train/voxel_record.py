"""The record buffer of mode `guided`: highlights behind one another on the raster stay apart."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import indices, indices_of_each
from bokehguide.render.transfers import sent
from bokehguide.train.ranks import Ranks
from bokehguide.train.record_buffer import Raster, Records

OCTAVES, PER_OCTAVE = 8, 4
"""Layers of depth on either side of the focal plane, by defocus |1 - focus distance / Z|, which is what the width of a
circle of confusion goes by: so many doublings up to 4, so many layers in each."""
SIDE = OCTAVES * PER_OCTAVE
LAYERS = 2 * SIDE
TEXELS = 8
"""There is a voxel for so many texels at most; of more, those stay that have seen most light. About as many may wait."""
WAITING = 1 << 17
"""Rows of new samples that are kept before they are added up; more, where more are left then."""


class VoxelRecord(Raster):
    """A raster with a margin whose cells keep sample count and radiance. What is bright in them is kept by depth as well.

    Only samples above a threshold make a cell one of voxels, from the next `settle` on: there are as many as highlights
    cover, and not one for each cell and depth. Positions in them are averaged as in `RecordBuffer`.

    sums: `[2, cells]`: count, Σ L. voxels: float64 `[K, 6]`, in ascending order: its number (cell · LAYERS + layer, from
    near to far), count, Σ L, Σ L·(X/Z, Y/Z, 1/Z), camera frame; waiting: those of the samples since the last `settle`, of all
    ranks up to the last `merge`.
    """

    def __init__(self, camera: ThinLensCamera, ranks: Ranks | None = None):
        super().__init__(camera, 2, ranks)
        self._focus_distance = camera.lens.focus_distance
        for name in ("voxels", "waiting"):
            self.register_buffer(name, torch.zeros(0, 6, dtype=torch.float64))
        self.register_buffer("_lit", torch.zeros(self.sums.shape[1], dtype=torch.bool), persistent=False)
        """Cells that have voxels."""
        self._new: list[Tensor] = []
        """Rows of this rank's samples since the last `merge`."""
        self._arrived, self._waiting = 0, 0.0
        """How many samples those are, and how many are in `waiting`: numbers that the host knows."""
        self._most = self.sums.shape[1] // TEXELS
        self._fewest = 0
        """New rows that are worth adding up, at least, so that it costs no more than in proportion to the samples."""

    def add(self, batches: Sequence[Records], threshold: float) -> None:
        """Add samples to their cells, and to voxels those that are brighter than the threshold or lie in cells that have some."""
        count, radiance = self.mine
        threshold, parts = sent(threshold, count.device, torch.float32), []
        for cells, points, luminance in batches:
            cells, inside, light, bright = _sorted_out(cells, luminance, self._lit, threshold)
            count.index_add_(0, cells, inside)
            radiance.index_add_(0, cells, light)
            parts.append((cells, points, light, bright > 0.0))
        for (cells, points, light, _), lit in zip(parts, indices_of_each([bright for *_, bright in parts])):
            self._add_lit(cells.index_select(0, lit), points.index_select(1, lit).double(), light.index_select(0, lit).double())

    def _add_lit(self, cells: Tensor, points: Tensor, light: Tensor) -> None:
        x, y, depth = points
        number = cells * LAYERS + self._layers(depth)
        self._new.append(torch.stack((number, torch.ones_like(light), light, light * x / depth, light * y / depth, light / depth), dim=1))
        self._arrived += len(light)
        if sum(map(len, self._new)) > max(WAITING, self._fewest):
            self._add_up()

    def _layers(self, depth: Tensor) -> Tensor:
        """Layer of each depth `[N]`, 0 … LAYERS - 1 from near to far, int64 `[N]`."""
        defocus = 1.0 - self._focus_distance / depth
        place = (PER_OCTAVE * (defocus.abs().log2() + OCTAVES - 2)).clamp(0.0, SIDE - 1.0).long()
        return torch.where(defocus < 0.0, SIDE - 1 - place, SIDE + place)

    def _add_up(self) -> None:
        """Make what is new one list: of one rank alone, with what waits, in the samples' order, whenever it is done."""
        if self.ranks.alone:
            self._let_wait(_added_up([self.waiting, *self._new]))
            self._fewest = len(self.waiting)
        else:
            self._new = [_added_up(self._new)]
            self._fewest = 2 * len(self._new[0])

    def merge(self) -> None:
        """Let every rank know the samples of all; collective."""
        super().merge()
        self._add_up()
        if not self.ranks.alone:
            self._let_wait(_added_up([self.waiting, *self.ranks.gathered(self._new[0])]))
            self._fewest = 0

    def _let_wait(self, rows: Tensor) -> None:
        """From now on these rows, on the host, wait, and no others do."""
        self.waiting, self._waiting = rows.to(self.sums.device), float(rows[:, 1].sum())
        self._new, self._arrived = [], 0

    def end_step(self) -> None:
        """Settle in the middle of a block, where more samples wait than there may be voxels; collective."""
        [new] = self.ranks.totals(self._arrived)
        if new + self._waiting > self._most:
            self.settle()

    def settle(self) -> None:
        """Add the voxels of new samples to those of the others; collective."""
        self.merge()
        voxels = _added_up([self.voxels, self.waiting])
        if len(voxels) > self._most:
            voxels = voxels[voxels[:, 2].topk(self._most).indices.sort().values]
        self.voxels = voxels.to(self.sums.device)
        self._let_wait(torch.zeros(0, 6, dtype=torch.float64))
        self._fewest = 0
        self._light_up()

    def _light_up(self) -> None:
        self._lit.zero_()
        self._lit[self.voxels[:, 0].long() // LAYERS] = True

    def bright(self, threshold: float) -> tuple[Tensor, Tensor, Tensor]:
        """Cells int64 `[K]` of voxels whose mean luminance is above the threshold, each voxel's position `[3, K]` and that `[K]`.

        The mean is that over the cell's samples which got so far: what met nearer voxels saw nothing of this one.
        """
        number, count, light, x, y, inverse_depth = self.voxels.T.contiguous()
        cells = number.long() // LAYERS
        before = count.cumsum(0) - count
        nearer = before - before[torch.searchsorted(cells, cells)]
        radiance = light / torch.maximum(self.sums[0, cells] - nearer, count)
        index = indices(radiance > threshold)
        points = (torch.stack((x, y, light)) / inverse_depth)[:, index]
        return cells[index], points.float(), radiance[index].float()

    def _load_from_state_dict(self, state_dict, prefix, *args):
        """Raises ValueError where voxels are none."""
        for name in ("voxels", "waiting"):
            rows = state_dict[prefix + name]
            self._require_rows(rows)
            setattr(self, name, torch.empty_like(rows, device=self.sums.device))
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._let_wait(self.waiting.cpu())
        self._fewest = 0
        self._light_up()

    def _require_rows(self, rows: Tensor) -> None:
        if rows.ndim != 2 or rows.shape[1] != 6 or rows.dtype != torch.float64:
            raise ValueError("voxels that are none")
        number, count, light, *_, inverse_depth = rows.T
        if not bool((count > 0.0).all() and (light >= 0.0).all() and ((inverse_depth > 0.0) == (light > 0.0)).all()):
            raise ValueError("voxels without samples or depth")
        inside = bool((number >= 0.0).all() and (number < self.sums.shape[1] * LAYERS).all())
        if not inside or not bool((number == number.floor()).all() and (number.diff() > 0.0).all()):
            raise ValueError("voxels outside the record buffer")


@kernel
def _sorted_out(cells: Tensor, luminance: Tensor, lit: Tensor, threshold: Tensor) -> tuple[Tensor, ...]:
    """Cells of samples, 0 for those outside; 1 for samples inside, 0 for the others; the luminance that counts; and 1 for those
    that are for voxels; `[N]` each."""
    inside, cells = cells >= 0, cells.clamp(min=0)
    light = torch.where(inside, luminance, 0.0)
    bright = inside & ((light > threshold) | lit.index_select(0, cells))
    return cells, inside.to(light.dtype), light, bright.to(light.dtype)


def _added_up(parts: list[Tensor]) -> Tensor:
    """Rows of some lists as one, each voxel once, in ascending order; on the CPU, where they add up to the same bits on every rank."""
    if not parts:
        return torch.zeros(0, 6, dtype=torch.float64)
    rows = torch.cat([part.cpu() for part in parts])
    number, place = rows[:, 0].unique(return_inverse=True)
    sums = torch.zeros(len(number), 5, dtype=rows.dtype).index_add_(0, place, rows[:, 1:])
    return torch.cat((number[:, None], sums), dim=1)
