"""What comes of one step: the results of its batches, and the figures that sum them up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from bokehguide.render.path_tracer import LightsChosen
from bokehguide.render.timer import PhaseTimer
from bokehguide.train.guide import BatchLesson, GuidedBatch
from bokehguide.train.ranks import Ranks


@dataclass
class StepStats:
    """What a step did, on all ranks; kl, beta and outside are NaN where nothing was guided."""

    step: int
    samples: int
    rays: int
    seconds: float
    kl: float
    beta: float
    gaussians: int
    outside: float


class GuideCounts(NamedTuple):
    """Guided pixels of a batch, draws of them outside the lens, and the sum of their β."""

    guided: int = 0
    outside: int = 0
    beta: float = 0.0

    @classmethod
    def of(cls, batch: GuidedBatch | None, weight: Tensor) -> GuideCounts:
        """weight: of the samples, 0 outside the lens, `[N]`."""
        if batch is None:
            return cls()
        mixture = batch.distribution
        return cls(int(mixture.guided.sum()), int(((weight == 0.0) & mixture.guided).sum()), float(mixture.beta.sum()))


@dataclass
class BatchResult:
    """What a batch leaves behind, beside the film: records are cells, positions and luminance for the record buffer; lights
    are for the light guide."""

    samples: int
    rays: int
    timer: PhaseTimer
    counts: GuideCounts = GuideCounts()
    lesson: BatchLesson | None = None
    records: tuple[Tensor, Tensor, Tensor] | None = None
    lights: LightsChosen | None = None


def step_stats(step: int, results: list[BatchResult], seconds: float, gaussians: int, ranks: Ranks) -> StepStats:
    """The sums over a step's batches on all ranks; collective."""
    counts = [sum(column) for column in zip(*(result.counts for result in results))] or [0, 0, 0.0]
    kl = sum(result.lesson.kl for result in results if result.lesson is not None)
    work = (sum(result.samples for result in results), sum(result.rays for result in results))
    samples, rays, guided, outside, beta, kl = ranks.totals(*work, *counts, kl)
    kl, beta, outside = (value / guided if guided else math.nan for value in (kl, beta, outside))
    return StepStats(step, int(samples), int(rays), seconds, kl, beta, gaussians, outside)


def finite(light: Tensor, good: Tensor) -> Tensor:
    """Luminance `[N]` of the samples that the film took, 0 for the others."""
    return light.nan_to_num(0.0, 0.0, 0.0) * good
