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
from bokehguide.train.record_buffer import Records


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


def guide_figures(batch: GuidedBatch | None, weight: Tensor, lesson: BatchLesson | None) -> Tensor:
    """Guided pixels of a batch, draws of them outside the lens, the sum of their β, and the one-sample KL, float64 `[4]`; weight: of
    the samples, 0 outside the lens, `[N]`."""
    if batch is None or lesson is None:
        return weight.new_zeros(4, dtype=torch.float64)
    guided, beta = batch.distribution.guided, batch.distribution.beta
    return torch.stack([figure.double() for figure in (guided.sum(), ((weight == 0.0) & guided).sum(), beta.sum(), lesson.kl)])


@dataclass
class BatchResult:
    """What a batch leaves behind, beside the film: figures are those of the guide (`guide_figures`), records are for its
    record buffer, lights for the light guide."""

    samples: int
    rays: int
    timer: PhaseTimer
    figures: Tensor | None = None
    lesson: BatchLesson | None = None
    records: Records | None = None
    lights: LightsChosen | None = None


def step_stats(step: int, results: list[BatchResult], seconds: float, gaussians: int, ranks: Ranks) -> StepStats:
    """The sums over a step's batches on all ranks; collective."""
    # On a GPU the host waits for these here, once, and not in each batch.
    figures = [result.figures for result in results if result.figures is not None]
    of_guide = torch.stack(figures).sum(0).tolist() if figures else [0.0, 0.0, 0.0, 0.0]
    work = (sum(result.samples for result in results), sum(result.rays for result in results))
    samples, rays, guided, outside, beta, kl = ranks.totals(*work, *of_guide)
    kl, beta, outside = (value / guided if guided else math.nan for value in (kl, beta, outside))
    return StepStats(step, int(samples), int(rays), seconds, kl, beta, gaussians, outside)


def finite(light: Tensor, good: Tensor) -> Tensor:
    """Luminance `[N]` of the samples that the film took, 0 for the others."""
    return light.nan_to_num(0.0, 0.0, 0.0) * good
