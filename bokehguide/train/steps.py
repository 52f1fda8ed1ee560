"""What comes of one step: the results of its batches, and the figures that sum them up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
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


def guide_counts(batch: GuidedBatch | None, weight: Tensor) -> Tensor:
    """Guided pixels of a batch, draws of them outside the lens, and the sum of their β, float64 `[3]`; weight: of the samples,
    0 outside the lens, `[N]`."""
    if batch is None:
        return weight.new_zeros(3, dtype=torch.float64)
    guided, beta = batch.distribution.guided, batch.distribution.beta
    return torch.stack((guided.sum().double(), ((weight == 0.0) & guided).sum().double(), beta.sum().double()))


@dataclass
class BatchResult:
    """What a batch leaves behind, beside the film: counts are those of the guide (`guide_counts`), records are cells, positions
    and luminance for the record buffer; lights are for the light guide."""

    samples: int
    rays: int
    timer: PhaseTimer
    counts: Tensor | None = None
    lesson: BatchLesson | None = None
    records: tuple[Tensor, Tensor, Tensor] | None = None
    lights: LightsChosen | None = None


def step_stats(step: int, results: list[BatchResult], seconds: float, gaussians: int, ranks: Ranks) -> StepStats:
    """The sums over a step's batches on all ranks; collective."""
    # On a GPU the host waits for these here, once, and not in each batch.
    counted = [result.counts for result in results if result.counts is not None]
    counts = torch.stack(counted).sum(0).tolist() if counted else [0.0, 0.0, 0.0]
    kl = float(sum(result.lesson.kl.double() for result in results if result.lesson is not None))
    work = (sum(result.samples for result in results), sum(result.rays for result in results))
    samples, rays, guided, outside, beta, kl = ranks.totals(*work, *counts, kl)
    kl, beta, outside = (value / guided if guided else math.nan for value in (kl, beta, outside))
    return StepStats(step, int(samples), int(rays), seconds, kl, beta, gaussians, outside)


def finite(light: Tensor, good: Tensor) -> Tensor:
    """Luminance `[N]` of the samples that the film took, 0 for the others."""
    return light.nan_to_num(0.0, 0.0, 0.0) * good
