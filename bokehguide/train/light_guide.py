"""Which lights surfaces are lit by: learnt for tiles of the frame as the middle of the lens sees it, block by block of steps.

What is out of focus hides behind nothing: once the lens points are guided, most of the noise that is left is that of
direct light where the camera's rays first land. There the power of the lamps and their distance say little: they do
not know what is in the shade, what a glossy surface mirrors, or which way it faces. The second moments
of what each cluster of lights brought do: a choice by their roots has the least variance.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.clusters import ClusterTable
from bokehguide.render.kernels import kernel
from bokehguide.render.light_choice import LightChoice
from bokehguide.train.rank_sums import RankSums
from bokehguide.train.ranks import Ranks

TILES, SMALLEST = 80, 4
"""Tiles along the longer side of the frame, and pixels along the side of a tile: in a smaller one there is too little to learn from."""
POOLS = ((1, 0.5), (3, 0.3), (7, 0.2))
"""Tiles across the squares whose moments are shared, and their weights."""
SEEN_BEFORE = 0.2
"""Samples of each cluster in each tile that are taken to have arrived already."""
DARKEST = 0.05
"""Least share of a cluster's light that is expected to arrive."""
BRIGHTEST = 1e30
"""What is worth more, and what is infinite, counts as this much."""


class LightGuide(RankSums):
    """Learns which clusters of lights to sample where a pixel's rays first land.

    clusters: how many there are. `add` takes what steps have seen; `update` ends a block.
    sums: `[3, tiles, clusters]`, of squared worth (see `LightsChosen`), of samples, and of
    the share of their light that arrived; probability, seen: what the present block chooses by, `[tiles, clusters]`, all
    0 in the first.
    """

    def __init__(self, camera: ThinLensCamera, clusters: int, ranks: Ranks | None = None):
        size = max(-(-max(camera.width, camera.height) // TILES), SMALLEST)
        across, down = -(-camera.width // size), -(-camera.height // size)
        device, shape = camera.position.device, (across * down, clusters)
        super().__init__(torch.zeros(3, *shape, dtype=torch.float64, device=device), ranks)
        self._camera, self._size, self._across, self._down = camera, size, across, down
        self.register_buffer("probability", torch.zeros(shape, device=device))
        self.register_buffer("seen", torch.zeros(shape, device=device))
        self.register_buffer("block", torch.tensor(1))
        self._count = torch.tensor([clusters], dtype=torch.int32, device=device)
        self._table: ClusterTable | None = None

    def tiles(self, points: Tensor) -> Tensor:
        """Tile in which the middle of the lens sees each world point `[3, N]`, int32 `[N]`; the nearest for one that it does not see."""
        local = self._camera.axes.T @ (points - self._camera.position)
        column, row = (self._camera.raster(local) / self._size).nan_to_num(0.0, 0.0, 0.0)
        column, row = column.clamp(0.0, self._across - 1.0), row.clamp(0.0, self._down - 1.0)
        return row.int() * self._across + column.int()

    def choice(self, points: Tensor) -> LightChoice:
        """How paths choose in this block at world points `[3, N]`."""
        return LightChoice(self.tiles(points), self._table, int(self.block), None if self._table is None else self.seen)

    def add(self, tiles: Tensor, clusters: Tensor, worth: Tensor, seen: Tensor) -> None:
        """Add light samples, `[N]` each; tiles, clusters: int32, of the latter -1 for none."""
        place, *rows = _rows(tiles, clusters, worth, seen, self._count)
        for total, values in zip(self.mine.view(3, -1), rows):
            total.index_add_(0, place, values)  # double, or sums, and choices by them, would depend on which rank adds first

    def update(self, step: int) -> None:
        """Begin a block of steps with `step`: choose by all that was seen before it; collective."""
        self.merge()
        self.block.fill_(step)
        moments, tried, arrived = (self._pooled(total) for total in self.sums)
        roots = moments.sqrt()
        whole = roots.sum(1, keepdim=True)
        self.probability.copy_(torch.where(whole > 0.0, roots / whole.clamp(min=1e-300), 1.0 / roots.shape[1]))
        self.seen.copy_(((arrived + SEEN_BEFORE) / (tried + SEEN_BEFORE)).clamp(min=DARKEST))
        self._table = ClusterTable(self.probability.double())

    def _pooled(self, total: Tensor) -> Tensor:
        """A sum `[tiles, clusters]` as tiles share it with those around."""
        clusters = total.shape[1]
        pooled = torch.zeros(self._down, self._across, clusters, dtype=total.dtype, device=total.device)
        for width, share in POOLS:
            of_rows, of_columns = (_means(count, width).to(total.device) for count in (self._down, self._across))
            rows = (of_rows @ total.view(self._down, -1)).view(pooled.shape)
            pooled.add_(of_columns @ rows, alpha=share)
        return pooled.view(total.shape)

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load what was learnt. Raises ValueError where rows of probabilities are none."""
        result = super().load_state_dict(state_dict, *args, **kwargs)
        whole, learnt = self.probability.sum(1), bool(self.probability.any())
        negative = any(bool((values < 0.0).any()) for values in (self.sums, self.seen, self.probability))
        if negative or learnt and bool(((whole - 1.0).abs() > 1e-4).any()):
            raise ValueError("what was learnt of lights is no choice among them")
        self._table = ClusterTable(self.probability.double()) if learnt else None
        return result


@kernel
def _rows(tiles: Tensor, clusters: Tensor, worth: Tensor, seen: Tensor, count: Tensor) -> tuple[Tensor, ...]:
    """Where samples `[N]` are to be added in a table with `count` clusters in a row, int32 `[N]`, and what, float64 `[N]` each."""
    counted = (clusters >= 0).double()
    worth = worth.double().nan_to_num(0.0, BRIGHTEST).clamp(max=BRIGHTEST)
    return tiles * count + clusters.clamp(min=0), worth * worth * counted, counted, seen * counted


def _means(count: int, width: int) -> Tensor:
    """The matrix float64 `[count, count]` that takes the mean of the `width` tiles about each in a row, of fewer at its ends."""
    place = torch.arange(count)
    near = ((place - place[:, None]).abs() <= width // 2).double()
    return near / near.sum(1, keepdim=True)
