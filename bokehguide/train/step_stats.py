"""The outcome of one step: the results of its batches, and the figures that sum them up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from bokehguide.guiding.protocols import LensRecord
from bokehguide.runtime.distributed import Ranks
from bokehguide.runtime.timer import PhaseTimer


@dataclass
class StepStats:
    """Figures of a step, summed over all ranks.

    samples, rays: numbers in this step. kl, beta, outside: one-sample KL, mean β, and share of lens points outside the aperture,
    over the guided pixels; NaN without guided pixels. gaussians: number of components of the learned field.
    """

    step: int
    samples: int
    rays: int
    seconds: float
    kl: float
    beta: float
    gaussians: int
    outside: float


@dataclass
class BatchResult:
    """The results of a batch, except the film. lens, lights: reports to the lens sampler and to the light strategy."""

    samples: int
    rays: int
    timer: PhaseTimer
    lens: LensRecord = field(default_factory=LensRecord)
    lights: object = None

    def release(self) -> None:
        """Free the reports, after the strategies have added them; the figures stay."""
        self.lens, self.lights = LensRecord(self.lens.figures), None


def step_stats(step: int, results: Sequence[BatchResult], seconds: float, gaussians: int, ranks: Ranks) -> StepStats:
    """The sums over a step's batches on all ranks; collective."""
    # On a GPU the host waits here once, and not in each batch.
    figures = [result.lens.figures for result in results if result.lens.figures is not None]
    of_guide = torch.stack(figures).sum(0).tolist() if figures else [0.0, 0.0, 0.0, 0.0]
    work = (sum(result.samples for result in results), sum(result.rays for result in results))
    samples, rays, guided, outside, beta, kl = ranks.totals(*work, *of_guide)
    kl, beta, outside = (value / guided if guided else math.nan for value in (kl, beta, outside))
    return StepStats(step, int(samples), int(rays), seconds, kl, beta, gaussians, outside)
