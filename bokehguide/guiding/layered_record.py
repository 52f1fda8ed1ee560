"""The record of primary hits in the mode `guided`, which separates highlights at different depths in one cell."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import torch
from torch import Tensor

from bokehguide.guiding.inheritance import Learned
from bokehguide.guiding.record_buffer import Raster, Records
from bokehguide.render.camera import ThinLensCamera
from bokehguide.runtime import native
from bokehguide.runtime.device import to_device
from bokehguide.runtime.distributed import Ranks
from bokehguide.runtime.indexing import indices, indices_of_each

OCTAVES, PER_OCTAVE = 8, 4
"""Layers of depth on either side of the focal plane: number of octaves, and layers in each octave.

The octaves divide the defocus |1 - focus distance / Z|, up to a defocus of 4. The diameter of a circle of confusion is
proportional to the defocus."""
SIDE = OCTAVES * PER_OCTAVE
LAYERS = 2 * SIDE
CELLS_PER_VOXEL = 8
"""Number of raster cells divided by the largest number of voxels. Beyond this number, the record drops the voxels with the least
light. The largest number of waiting samples is the same."""
MIN_ROWS = 1 << 17
"""Least number of new rows at which the record sums them by voxel."""


class VoxelRecord(Raster):
    """A raster with a margin, whose cells store number and radiance of samples. Bright cells also store their light in voxels.

    A voxel is one layer of depth in one cell. Only samples above a threshold create voxels, at the next `merge_voxels`. The
    number of voxels therefore grows with the highlights, not with cells times layers. Positions are averaged as in
    `RecordBuffer`.

    by_depth: whether a cell has one voxel for each layer of depth, else one for all depths. sums: `[2, cells]`: count, Σ L.
    voxels: float64 `[K, 6]`, in ascending order. The columns are number (cell · LAYERS + layer, from near to far), count, Σ L and
    Σ L·(X/Z, Y/Z, 1/Z), camera frame. waiting: rows of the same columns from samples since the last `merge_voxels`. They include
    the samples of all ranks up to the last `merge`.
    """

    voxels: Tensor
    waiting: Tensor
    _lit: Tensor

    def __init__(self, camera: ThinLensCamera, ranks: Ranks | None = None, by_depth: bool = True):
        super().__init__(camera, 2, ranks)
        self._camera, self._by_depth = camera, by_depth
        self._focus_distance = camera.lens.focus_distance
        for name in ("voxels", "waiting"):
            self.register_buffer(name, torch.zeros(0, 6, dtype=torch.float64))
        self.register_buffer("_lit", torch.zeros(self.sums.shape[1], dtype=torch.bool), persistent=False)
        """Cells that have voxels."""
        self._new: list[Tensor] = []
        """Rows from samples of this rank since the last `merge`."""
        self._new_count, self._waiting_count = 0, 0.0
        """Numbers of samples in `_new` and in `waiting`, stored on the host."""
        self._max_voxels = self.sums.shape[1] // CELLS_PER_VOXEL
        self._min_rows = 0
        """Least number of new rows at which `_sum_new` sums, so that the cost is proportional to the number of samples."""

    def add(self, batches: Sequence[Records], threshold: float, threads: int = 1) -> None:
        """Add samples to their cells. Samples above the threshold and samples in cells with voxels are also added to voxels."""
        core = native.core_on(self.mine.device)
        if core is None:
            rows = self._added(batches, to_device(threshold, self.mine.device, torch.float32))
        else:
            rows = self._added_by_core(core, batches, threshold, threads)
        self._new.append(rows)
        self._new_count += len(rows)
        if sum(map(len, self._new)) > max(MIN_ROWS, self._min_rows):
            self._sum_new()

    def _added(self, batches: Sequence[Records], threshold: Tensor) -> Tensor:
        """Add samples to their cells; returns the rows of samples for voxels, float64 `[K, 6]`."""
        bright = [_add_hits(self.mine, cells, light, self._lit, threshold) for cells, _, light in batches]
        rows = [torch.zeros(0, 6, dtype=torch.float64, device=self.mine.device)]
        for (cells, points, light), at in zip(batches, indices_of_each(bright)):
            rows.append(self._rows(*(values.index_select(-1, at) for values in (cells, points, light))))
        return torch.cat(rows)

    def _rows(self, cells: Tensor, points: Tensor, light: Tensor) -> Tensor:
        """Rows of samples in cells `[N]`, float64 `[N, 6]`."""
        light, (x, y, depth) = light.double(), points.double()
        number = cells * LAYERS + self._layers(depth)
        return torch.stack((number, torch.ones_like(light), light, light * x / depth, light * y / depth, light / depth), dim=1)

    def _added_by_core(self, core: ModuleType, batches: Sequence[Records], threshold: float, threads: int) -> Tensor:
        """`_added` by the native core."""
        bright = [torch.zeros(len(light), dtype=torch.bool) for *_, light in batches]
        hits = [(cells, points.contiguous(), light.contiguous(), each) for (cells, points, light), each in zip(batches, bright)]
        found = core.add_hits(self.mine, [(cells, *rest) for cells, _, *rest in hits], self._lit, threshold, threads)
        rows = torch.empty(found, 6, dtype=torch.float64)
        core.voxel_rows(hits, (self._focus_distance, PER_OCTAVE, OCTAVES, self._by_depth), rows)
        return rows

    def _layers(self, depth: Tensor) -> Tensor:
        """Layer of each depth `[N]`, 0 … LAYERS - 1 from near to far, int64 `[N]`."""
        defocus = 1.0 - self._focus_distance / depth
        place = (PER_OCTAVE * (defocus.abs().log2() + OCTAVES - 2)).clamp(0.0, SIDE - 1.0).long()
        return torch.where(defocus < 0.0, SIDE - 1 - place, SIDE + place) * self._by_depth

    def _sum_new(self) -> None:
        """Sum the new rows by voxel, in the order of the samples. A single rank sums them together with the waiting rows."""
        if self.ranks.alone:
            self._set_waiting(_summed([self.waiting, *self._new]))
            self._min_rows = len(self.waiting)
        else:
            self._new = [_summed(self._new)]
            self._min_rows = 2 * len(self._new[0])

    def merge(self) -> None:
        """Exchange the samples of all ranks; collective."""
        super().merge()
        self._sum_new()
        if not self.ranks.alone:
            self._set_waiting(_summed([self.waiting, *self.ranks.gathered(self._new[0])]))
            self._min_rows = 0

    def _set_waiting(self, rows: Tensor) -> None:
        """Replace both the waiting rows and the new rows by the given rows on the host."""
        self.waiting, self._waiting_count = rows.to(self.sums.device), float(rows[:, 1].sum())
        self._new, self._new_count = [], 0

    def end_step(self) -> None:
        """Merge the voxels within an epoch if the number of waiting samples exceeds the largest number of voxels; collective."""
        [new] = self.ranks.totals(self._new_count)
        if new + self._waiting_count > self._max_voxels:
            self.merge_voxels()

    def merge_voxels(self) -> None:
        """Add the waiting rows to the voxels; collective."""
        self.merge()
        voxels = _summed([self.voxels, self.waiting])
        if len(voxels) > self._max_voxels:
            voxels = voxels[voxels[:, 2].topk(self._max_voxels).indices.sort().values]
        self.voxels = voxels.to(self.sums.device)
        self._set_waiting(torch.zeros(0, 6, dtype=torch.float64))
        self._min_rows = 0
        self._mark_lit()

    def _mark_lit(self) -> None:
        self._lit.zero_()
        self._lit[self.voxels[:, 0].long() // LAYERS] = True

    def inherit(self, learned: Learned, sums: Tensor, voxels: Tensor, waiting: Tensor) -> None:
        """Begin with the voxels of an earlier record, at their places in this camera's frame.

        sums, voxels, waiting: as those of this class. After a move of the camera, all cells have the mean number of samples.
        """
        rows = _summed([voxels, waiting])
        rows = rows[rows[:, 3:].isfinite().all(1) & (rows[:, 2] > 0.0) & (rows[:, 5] > 0.0)]
        count, light, x, y, inverse_depth = rows[:, 1:].T
        points = (torch.stack((x, y, light)) / inverse_depth).float()
        if learned.same_view(self._camera):
            self.sums.copy_(learned.share * sums)
        else:
            points = learned.seen_by(self._camera, points)
            self.sums[0] = learned.share * sums[0].sum() / (sums[0] > 0.0).sum().clamp(min=1)
        cells = self.cells(self._camera, points)
        kept = indices(cells >= 0)
        before = torch.stack((count, light))[:, kept] * learned.share
        x, y, depth = points[:, kept].double()
        number = cells[kept] * LAYERS + self._layers(depth)
        new = torch.stack((number, *before, before[1] * x / depth, before[1] * y / depth, before[1] / depth), dim=1)
        self._set_waiting(_summed([new]))

    def bright(self, threshold: float) -> tuple[Tensor, Tensor, Tensor]:
        """Cells int64 `[K]`, positions `[3, K]` and mean luminance `[K]` of voxels whose mean luminance is above the threshold.

        The mean includes the samples of the cell at this depth and beyond. Samples that end in nearer voxels did not reach the
        voxel.
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
        """Raises ValueError for voxels that no record can have."""
        for name in ("voxels", "waiting"):
            rows = state_dict[prefix + name]
            self._require_rows(rows)
            setattr(self, name, torch.empty_like(rows, device=self.sums.device))
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._set_waiting(self.waiting.cpu())
        self._min_rows = 0
        self._mark_lit()

    def _require_rows(self, rows: Tensor) -> None:
        if rows.ndim != 2 or rows.shape[1] != 6 or rows.dtype != torch.float64:
            raise ValueError("rows that are not voxels")
        number, count, light, *_, inverse_depth = rows.T
        if not bool((count > 0.0).all() and (light >= 0.0).all() and ((inverse_depth > 0.0) == (light > 0.0)).all()):
            raise ValueError("voxels without samples or depth")
        inside = bool((number >= 0.0).all() and (number < self.sums.shape[1] * LAYERS).all())
        if not inside or not bool((number == number.floor()).all() and (number.diff() > 0.0).all()):
            raise ValueError("voxels outside the record buffer")


def _add_hits(sums: Tensor, cells: Tensor, luminance: Tensor, lit: Tensor, threshold: Tensor) -> Tensor:
    """Add samples `[N]` to their cells, -1 for none; returns whether voxels add each sample, bool `[N]`."""
    inside, cells = cells >= 0, cells.clamp(min=0)
    light = torch.where(inside, luminance, 0.0)
    count, radiance = sums
    count.index_add_(0, cells, inside.to(light.dtype))
    radiance.index_add_(0, cells, light)
    return inside & ((light > threshold) | lit.index_select(0, cells))


def _summed(parts: list[Tensor]) -> Tensor:
    """Rows of all lists, summed by voxel, in ascending order. The sums run on the CPU, so that all ranks get the same bits."""
    if not parts:
        return torch.zeros(0, 6, dtype=torch.float64)
    rows = torch.cat([part.cpu() for part in parts])
    number, place = rows[:, 0].unique(return_inverse=True)
    sums = torch.zeros(len(number), 5, dtype=rows.dtype).index_add_(0, place, rows[:, 1:])
    return torch.cat((number[:, None], sums), dim=1)
