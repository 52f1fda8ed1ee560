"""Learned light sampling at primary hits: each tile of the frame learns the probabilities of clusters of lights.

With a guided lens, direct light at primary hits causes most of the remaining noise. The power and the distance of an emitter
do not predict shadows, glossy reflections and the orientation of surfaces. The second moments of the contributions of each
cluster include these effects. Probabilities in proportion to the square roots of the second moments minimise the variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.guiding.cluster_lights import ClusterTables, Counts, MixtureLights, VoxelLights, sample_counts
from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.inheritance import Learned, moved
from bokehguide.guiding.mis_factors import MisFactors
from bokehguide.guiding.tile_pools import TilePools
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lights.base import DirectLight, LightDistribution, LightSampler
from bokehguide.render.lights.clusters import ClusterTable
from bokehguide.render.lights.power_sampler import PowerLightSampler
from bokehguide.render.native_tables import cluster_lights
from bokehguide.render.observer import CoreReport, PathObserver
from bokehguide.render.vector import divisor, luminance
from bokehguide.runtime import native
from bokehguide.runtime.distributed import Ranks, RankSums

TILES, SMALLEST = 80, 4
"""Largest number of tiles along the longer side of the frame, and least side of a tile in pixels.

A smaller tile has too few samples to learn from."""
PRIOR_VISIBLE = 0.2
"""Prior: number of visible samples of each cluster in each tile before the first sample."""
MIN_VISIBILITY = 0.05
"""Smallest expected visibility of a cluster."""
MAX_CONTRIBUTION = 1e30
"""Contributions in learning are clamped to this value, so that second moments stay finite."""


class LightSamples(NamedTuple):
    """Light samples at primary hits, one for each of K paths; all fields are `[K]`.

    row, cluster: see `ClusterRecord`. contribution_rms: `ClusterRecord.contribution_rms` times the visibility.
    visibility: unblocked share of the light. difference: luminance of D (`mis_factors`).
    """

    row: Tensor
    cluster: Tensor
    contribution_rms: Tensor
    visibility: Tensor
    difference: Tensor


class LightBatch(NamedTuple):
    """What a batch adds to the sums of a `LearnedLightSampler`: fields of `LightSamples`, and `MisFactors.moments`."""

    row: Tensor
    cluster: Tensor
    contribution_rms: Tensor
    visibility: Tensor
    moments: Tensor


class LightSampleRecorder(PathObserver):
    """Records the light samples of one trace whose cluster a table chose. samples: list of at most one batch."""

    in_core = True

    def __init__(self) -> None:
        self.samples: list[LightSamples] = []

    def light_sample(self, paths: Tensor, light: DirectLight, contribution: Tensor, visibility: Tensor) -> None:
        """See `PathObserver`."""
        if light.clusters is not None:
            row, cluster, contribution_rms, broad = light.clusters
            found = luminance(contribution) * broad
            self.samples.append(LightSamples(row, cluster, contribution_rms * visibility, visibility, found))

    def broad_light(self, paths: Tensor, radiance: Tensor) -> None:
        """See `PathObserver`."""
        for found in self.samples:
            found.difference.index_add_(0, paths, luminance(radiance), alpha=-1)

    def reported(self, report: CoreReport) -> None:
        """See `PathObserver`."""
        if report.light_samples is not None:
            self.samples.append(LightSamples(*report.light_samples))


class LearnedLightSampler(RankSums, LightSampler):
    """Learns the probabilities with which primary hits sample clusters of lights.

    `add` takes the light samples of a batch; `update` ends an epoch.

    power: light sampler that owns the lights and the voxel grid. factors: learned factors of MIS weights by tile. counts: numbers
    of samples at a primary hit. pools: the grid of tiles.
    sums: float64 `[3, tiles, clusters]`: Σ contribution_rms² (see `LightSamples`), number of samples, Σ visibility.
    probability, visibility: probability and expected visibility in the present epoch, `[tiles, clusters]`, 0 in the first epoch.
    """

    in_core = True
    sums: Tensor
    probability: Tensor
    visibility: Tensor
    epoch: Tensor

    def __init__(
        self,
        camera: ThinLensCamera,
        power: PowerLightSampler,
        config: GuidedConfig,
        ranks: Ranks | None = None,
    ):
        size = max(-(-max(camera.width, camera.height) // TILES), SMALLEST)
        across, down = -(-camera.width // size), -(-camera.height // size)
        clusters = power.lights.clusters
        device, shape = camera.position.device, (across * down, clusters.count)
        super().__init__(torch.zeros(3, *shape, dtype=torch.float64, device=device), ranks)
        self._camera, self._power, self._size = camera, power, size
        self.pools = TilePools(across, down)
        self.register_buffer("probability", torch.zeros(shape, device=device))
        self.register_buffer("visibility", torch.zeros(shape, device=device))
        self.register_buffer("epoch", torch.tensor(1))
        self.factors = MisFactors(across * down, device, ranks)
        self.counts = sample_counts(power, Counts(config.light_candidates, config.bsdf_candidates))
        if clusters.triangles > 0:  # a further light sample lowers the error more there
            self.counts = Counts(sum(self.counts), 0)
        self._learns_visibility, self._learns_mis = config.learn_visibility, config.learn_mis
        self._tables: ClusterTables | None = None  # None in the first epoch
        self._core_lights: tuple[ClusterTables | None, object] | None = None

    def tiles(self, points: Tensor) -> Tensor:
        """Tile of each world point `[3, N]`, projected through the lens centre, int32 `[N]`.

        Points outside the frame belong to the nearest tile.
        """
        local = self._camera.axes.T @ (points - self._camera.position)
        column, row = (self._camera.raster(local) / self._size).nan_to_num(0.0, 0.0, 0.0)
        column, row = column.clamp(0.0, self.pools.across - 1.0), row.clamp(0.0, self.pools.down - 1.0)
        return row.int() * self.pools.across + column.int()

    def at(self, points: Tensor) -> LightDistribution:
        """Distribution of the present epoch at world points `[3, N]`."""
        tiles, tables = self.tiles(points), self._tables
        if tables is None:
            return VoxelLights(self._power, tiles, self.counts)
        return MixtureLights(self._power, tiles, tables, self.counts)

    def core_lights(self, core: ModuleType) -> object:
        """See `LightSampler`."""
        made, tables = self._core_lights, self._tables
        if made is None or made[0] is not tables:
            arrays, numbers = self._tile_numbers()
            if tables is not None:
                arrays |= {"cumulative": tables.table.cumulative, "visibility": tables.visibility, "factor": tables.factor}
            levels, first_step = (0, 1) if tables is None else (tables.table.levels, tables.first_step)
            numbers |= {"levels": levels, "first_step": first_step}
            numbers |= {"light_candidates": self.counts.lights, "bsdf_candidates": self.counts.bsdf}
            made = self._core_lights = (tables, cluster_lights(core, self._power.lights.clusters, arrays, numbers))
        return made[1]

    def _tile_numbers(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Arrays and numbers from which the native core finds the tiles of points."""
        camera = self._camera
        numbers = {"half_width": 0.5 * camera.width, "half_height": 0.5 * camera.height, "pixel_slope": camera.pixel_slope}
        numbers |= {"tile_size": self._size, "across": self.pools.across, "down": self.pools.down}
        return {"axes": camera.axes, "position": camera.position}, numbers

    def _make_tables(self) -> ClusterTables:
        """Tables of the present probabilities."""
        table = ClusterTable(self.probability.double())
        visibility = self.visibility if self._learns_visibility else torch.ones_like(self.visibility)
        return ClusterTables(table, visibility, self.factors.factor.clone(), int(self.epoch))

    def batch(self, samples: LightSamples, reflected: Tensor) -> LightBatch:
        """What to add for the samples of a batch; reflected: luminance that the paths reflect at their primary hits, `[K]`.

        Sums over tiles take the place of the values of paths that nothing else needs, so that a step keeps less memory.
        """
        return LightBatch(*samples[:4], self.factors.moments(samples.row, samples.difference, reflected))

    def add(self, batches: Sequence[LightBatch], threads: int = 1) -> None:
        """Add the light samples of batches. For the probabilities of clusters, samples of cluster -1 are ignored."""
        for batch in batches:
            self.factors.add(batch.moments)
        clusters, core = self.probability.shape[1], native.core_on(self.mine.device)
        if core is not None:
            core.add_light_samples(self.mine, [batch[:4] for batch in batches], clusters, MAX_CONTRIBUTION, threads)
            return
        for batch in batches:
            place, *rows = _rows(*batch[:4], clusters)
            for total, values in zip(self.mine.view(3, -1), rows):
                total.index_add_(0, place, values)  # double precision: the order of ranks does not matter

    def merge(self) -> None:
        """See `RankSums`."""
        super().merge()
        self.factors.merge()

    def update(self, step: int, threads: int = 1) -> None:
        """Begin an epoch at `step`: compute the probabilities from all samples so far; collective."""
        self.merge()
        if self._learns_mis:
            self.factors.update(self.pools.pooled)
        self.epoch.fill_(step)
        moments, tried, arrived = self.sums
        roots = self.pools.shrunk(moments, arrived, threads).sqrt()
        whole = roots.sum(1, keepdim=True)
        self.probability.copy_(torch.where(whole > 0.0, roots / divisor(whole, 1e-300), 1.0 / roots.shape[1]))
        tried, arrived = (self.pools.pooled(total, threads) for total in (tried, arrived))
        self.visibility.copy_(((arrived + PRIOR_VISIBLE) / (tried + PRIOR_VISIBLE)).clamp(min=MIN_VISIBILITY))
        self._tables = self._make_tables()

    def inherit(self, learned: Learned, sums: Tensor, of_factors: Tensor) -> None:
        """Begin with sums of an earlier render, `[3, tiles, clusters]` and `[2, tiles]`, where its surfaces lie in this frame.

        Tiles without samples get the mean of all tiles, with the weight of one sample.
        """
        if not bool(sums[1].any()):
            return
        if not learned.same_view(self._camera):
            sums, of_factors = self._moved(learned, sums), self._moved(learned, of_factors[..., None])[..., 0]
        mean = sums.mean(1, keepdim=True)
        empty = sums[1].sum(1, keepdim=True) == 0.0
        in_empty = empty * mean / mean[1].sum()
        self.sums.copy_(sums + in_empty)
        self.factors.sums.copy_(learned.share * of_factors)
        self.update(1)  # the first epoch relies on all earlier samples
        self.sums.copy_(learned.share * sums + in_empty)

    def _moved(self, learned: Learned, sums: Tensor) -> Tensor:
        """Sums at the tiles of this camera in which the middles of the earlier tiles lie."""
        tile = torch.arange(self.pools.across * self.pools.down)
        width, height, half = self._camera.width, self._camera.height, self._size // 2
        column = (tile % self.pools.across * self._size + half).clamp(max=width - 1)
        row = (tile // self.pools.across * self._size + half).clamp(max=height - 1)
        pixel = learned.pixels(self._camera)[row * width + column]
        place = pixel // width // self._size * self.pools.across + pixel % width // self._size
        return torch.stack([moved(each.T, torch.where(pixel >= 0, place, -1)).T for each in sums])

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Restore the state. Raises ValueError where probabilities are negative or rows do not sum to 1."""
        result = super().load_state_dict(state_dict, *args, **kwargs)
        whole, learned = self.probability.sum(1), bool(self.probability.any())
        negative = any(bool((values < 0.0).any()) for values in (self.sums, self.visibility, self.probability))
        if negative or (learned and bool(((whole - 1.0).abs() > 1e-4).any())):
            raise ValueError("probabilities of lights that are negative or do not sum to 1")
        if not self.factors.sound:
            raise ValueError("factors of MIS weights that are out of range")
        self._tables = self._make_tables() if learned else None
        return result


def _rows(tiles: Tensor, clusters: Tensor, contribution_rms: Tensor, visibility: Tensor, count: int) -> tuple[Tensor, ...]:
    """Flat table indices of samples, int32 `[N]`, and the summands, float64 `[N]` each. count: clusters in a row of the table."""
    counted = (clusters >= 0).double()
    contribution_rms = contribution_rms.double().nan_to_num(0.0, MAX_CONTRIBUTION).clamp(max=MAX_CONTRIBUTION)
    return tiles * count + clusters.clamp(min=0), contribution_rms * contribution_rms * counted, counted, visibility * counted
