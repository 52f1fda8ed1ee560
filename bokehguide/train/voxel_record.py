"""The record buffer of mode `guided`: highlights behind one another on the raster stay apart."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.pixels import indices
from bokehguide.train.ranks import Ranks
from bokehguide.train.record_buffer import Raster

OCTAVES, PER_OCTAVE = 8, 4
"""Layers of depth on either side of the focal plane, by defocus |1 - focus distance / Z|, which is what the width of a
circle of confusion goes by: so many doublings up to 4, so many layers in each."""
SIDE = OCTAVES * PER_OCTAVE
LAYERS = 2 * SIDE
TEXELS = 4
"""There is a voxel for so many texels at most; of more, those stay that have seen most light."""
WAITING = 1 << 18
"""Samples that are kept at a time before they are added up."""


class VoxelRecord(Raster):
    """A raster with a margin whose cells keep sample count and radiance. What is bright in them is kept by depth as well.

    Only samples above a threshold make a cell one of voxels, from the next `merge` on: there are as many as highlights
    cover, and not one for each cell and depth. Positions in them are averaged as in `RecordBuffer`.

    sums: `[2, cells]`: count, Σ L. voxels: float64 `[K, 6]`, in ascending order: its number (cell · LAYERS + layer, from
    near to far), count, Σ L, Σ L·(X/Z, Y/Z, 1/Z), camera frame.
    """

    def __init__(self, camera: ThinLensCamera, ranks: Ranks | None = None):
        super().__init__(camera, 2, ranks)
        self._focus_distance = camera.lens.focus_distance
        self.register_buffer("voxels", torch.zeros(0, 6, dtype=torch.float64))
        self.register_buffer("_lit", torch.zeros(self.sums.shape[1], dtype=torch.bool), persistent=False)
        """Cells that have voxels."""
        self._new: list[Tensor] = []
        """Voxels of this rank's samples since the last `merge`."""

    def add(self, cells: Tensor, points: Tensor, luminance: Tensor, threshold: float) -> None:
        """Add samples with camera-frame positions `[3, N]` and luminance `[N]` to their cells `[N]`, and to voxels those that
        are brighter than the threshold or lie in cells that have some."""
        index = indices(cells >= 0)
        cells, light = cells.index_select(0, index), luminance.index_select(0, index)
        count, radiance = self.mine
        count.index_add_(0, cells, torch.ones_like(light))
        radiance.index_add_(0, cells, light)
        lit = indices((light > threshold) | self._lit.index_select(0, cells))
        cells, light = cells.index_select(0, lit), light.index_select(0, lit).double()
        x, y, depth = points.index_select(1, index.index_select(0, lit)).double()
        number = cells * LAYERS + self._layers(depth)
        self._new.append(torch.stack((number, torch.ones_like(light), light, light * x / depth, light * y / depth, light / depth), dim=1))
        if sum(map(len, self._new)) > WAITING:
            self._new = [_added_up(self._new)]

    def _layers(self, depth: Tensor) -> Tensor:
        """Layer of each depth `[N]`, 0 … LAYERS - 1 from near to far, int64 `[N]`."""
        defocus = 1.0 - self._focus_distance / depth
        place = (PER_OCTAVE * (defocus.abs().log2() + OCTAVES - 2)).clamp(0.0, SIDE - 1.0).long()
        return torch.where(defocus < 0.0, SIDE - 1 - place, SIDE + place)

    def merge(self) -> None:
        """Let every rank know the samples of all; collective."""
        super().merge()
        found = _added_up(self._new)
        found = [found] if self.ranks.alone else self.ranks.gathered(found.cpu())
        voxels, most = _added_up([self.voxels, *(each.to(self.voxels.device) for each in found)]), self.sums.shape[1] // TEXELS
        if len(voxels) > most:
            voxels = voxels[voxels[:, 2].topk(most).indices.sort().values]
        self.voxels, self._new = voxels, []
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
        voxels = state_dict[prefix + "voxels"]
        self.voxels = torch.empty_like(voxels, device=self.sums.device)
        super()._load_from_state_dict(state_dict, prefix, *args)
        if voxels.ndim != 2 or voxels.shape[1] != 6 or not bool((voxels[:, [1, 2, 5]] >= 0.0).all()):
            raise ValueError("voxels that are none")
        number = voxels[:, 0]
        inside = bool((number >= 0.0).all() and (number < self.sums.shape[1] * LAYERS).all())
        if not inside or not bool((number == number.floor()).all() and (number.diff() > 0.0).all()):
            raise ValueError("voxels outside the record buffer")
        self._light_up()


def _added_up(parts: list[Tensor]) -> Tensor:
    """Voxels of some lists as one, each voxel once, in ascending order."""
    if not parts:
        return torch.zeros(0, 6, dtype=torch.float64)
    rows = torch.cat(parts)
    number, place = rows[:, 0].unique(return_inverse=True)
    sums = torch.zeros(len(number), 5, dtype=rows.dtype, device=rows.device).index_add_(0, place, rows[:, 1:])
    return torch.cat((number[:, None], sums), dim=1)
