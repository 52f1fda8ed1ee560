"""Paths whose light samples a table of clusters chooses, beside paths that sample by power."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bokehguide.guiding.cluster_lights import ClusterTables, Counts, MixtureLights
from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.light_sampler import LightSampleRecorder
from bokehguide.render.lights.base import LightDistribution, LightSampler
from bokehguide.render.lights.clusters import ClusterTable
from bokehguide.render.lights.power_sampler import PowerLightSampler
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.splitting import UNSPLIT, SplitPaths
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Scene

Ray = tuple[tuple[float, float, float], tuple[float, float, float]]

ROOM_RAY: Ray = ((0.1, 1.3, 1.5), (-0.1, -0.8, -1.5))
"""Origin and direction of a ray to the floor of `rooms.room`."""
COUNTS = Counts(GuidedConfig.light_candidates, GuidedConfig.bsdf_candidates)


class Everywhere(LightSampler):
    """A light sampler of the distributions that a function makes for points."""

    def __init__(self, distribution_of: Callable[[torch.Tensor], LightDistribution]):
        self._distribution_of = distribution_of

    def at(self, points: Tensor) -> LightDistribution:
        return self._distribution_of(points)


def learned_choice(power: PowerLightSampler, count: int, spread: float = 2.0) -> MixtureLights:
    """One of three rows for each of `count` paths, of probabilities that differ widely; some clusters are never chosen."""
    clusters = power.lights.clusters
    weights = np.random.default_rng(3).lognormal(0.0, spread, (3, clusters.count))
    weights[:, ::5] = 0.0
    weights[:, -1] = 1.0
    table = ClusterTable(torch.from_numpy(weights / weights.sum(axis=1, keepdims=True)))
    factor = torch.tensor([1.0, 0.4, 0.05])
    tables = ClusterTables(table, torch.ones(3, clusters.count), factor, 1)
    return MixtureLights(power, (torch.arange(count) % 3).int(), tables, COUNTS)


@dataclass
class OneTable(LightSampler):
    """A light sampler with one row of a table for all points, in proportion to weights, uniform without any.

    epoch: first step of the table; candidates, bsdf_candidates: light and BSDF samples of which resampling keeps one.
    factor: of MIS weights.
    """

    tracer: PathTracer
    weights: object = None
    epoch: int = 1
    candidates: int = 2
    bsdf_candidates: int = 1
    factor: float = 0.3

    def at(self, points: Tensor) -> MixtureLights:
        clusters = self.tracer.lights.clusters
        weights = np.ones(clusters.count) if self.weights is None else np.asarray(self.weights, np.float64)
        table = ClusterTable(torch.from_numpy((weights / weights.sum())[None]))
        factor = torch.full((1,), self.factor)
        tables = ClusterTables(table, torch.ones(1, clusters.count), factor, self.epoch)
        row = torch.zeros(points.shape[1], dtype=torch.int32)
        return MixtureLights(self.tracer.light_sampler, row, tables, Counts(self.candidates, self.bsdf_candidates))


@dataclass
class Traced:
    """The samples of a trace, and its record of light samples."""

    paths: PathSamples
    lights: LightSampleRecorder


def traced(
    lit: Scene, ray: Ray, count: int, learned: bool = True, step: int = 1, seed: int = 0, split: bool = False, **table
) -> Traced:
    """Paths along `count` copies of a ray; table: fields of `OneTable`, which chooses the lights where they are `learned`."""
    tracer, recorder = PathTracer(lit), LightSampleRecorder()
    origin = torch.tensor(ray[0])[:, None].repeat(1, count)
    direction = torch.nn.functional.normalize(torch.tensor(ray[1])[:, None].repeat(1, count), dim=0)
    random = PixelRandom(seed, step, torch.arange(count))
    sampler = OneTable(tracer, **table) if learned else None
    splitting = SplitPaths(torch.ones(count)) if split else UNSPLIT
    with torch.no_grad():
        rays = (origin, direction, random, PhaseTimer())
        paths = tracer.trace(*rays, light_sampler=sampler, splitting=splitting, observers=(recorder,))
    return Traced(paths, recorder)


def under(lit: Scene, suns) -> Scene:
    """The scene with suns above."""
    return replace(lit, suns=tuple(suns))
