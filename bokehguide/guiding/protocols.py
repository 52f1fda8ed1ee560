"""The three strategies of a mode, and the data that a step of rendering passes to them.

A step reads: pixels, focus points, lens query, lens points, rays, paths, reuse, film, record, update. A `LensSampler` answers
the lens query, a `LightStrategy` chooses light samples at primary hits, and a `SampleReuse` lets pixels use each other's
samples. The base classes are complete strategies that learn nothing; a subclass overrides the methods that it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from bokehguide.models.base import LensDensity
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import FilmSamples
from bokehguide.render.lights.base import LightSampler
from bokehguide.render.observer import PathObserver
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.splitting import UNSPLIT, Splitting
from bokehguide.runtime.distributed import Ranks
from bokehguide.runtime.indexing import Pixels
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Scene


def starts_epoch(step: int) -> bool:
    """Whether an epoch begins with a step: 1, 2, 3, 5, 9, 17, … so that lengths of epochs are powers of two."""
    return step == 1 or (step - 1) & (step - 2) == 0


@dataclass(frozen=True)
class ModeContext:
    """All that strategies may be built from.

    scene, camera, tracer: of the render. film_width, film_height: of the rendered part of the frame, pixels.
    settings: the render's `RenderSettings`. ranks: the processes that share the work.
    owned: pixels of the frame that this rank answers for, bool `[pixels]`.
    """

    scene: Scene
    camera: ThinLensCamera
    tracer: PathTracer
    film_width: int
    film_height: int
    settings: Any
    ranks: Ranks
    owned: Tensor


@dataclass(frozen=True)
class PixelBatch:
    """N pixels in one step.

    places: pixels of the film; pixels: the same pixels of the frame. raster: positions on the film, pixels, `[2, N]`;
    subpixel: the same within the pixel. focus: focus points x_F, camera frame, metres, `[3, N]`. random: the random numbers
    of this step. mean_luminance: mean luminance of the frame before this step; 1 in the first step.
    """

    step: int
    places: Pixels
    pixels: Pixels
    raster: Tensor
    subpixel: Tensor
    focus: Tensor
    random: PixelRandom
    mean_luminance: float


class LensPoints(NamedTuple):
    """One lens point for each of N pixels.

    points: metres, `[2, N]`. weight: W / (A q) of Eq. 11, 0 for a point that passes no light, `[N]`. at: the mixture's
    densities at the points, where a query has a mixture. candidate: which candidate of the mixture was drawn, int64 `[N]`,
    -1 for the uniform part.
    """

    points: Tensor
    weight: Tensor
    at: LensDensity | None = None
    candidate: Tensor | None = None


class LensQuery:
    """The distribution of lens points of one batch of pixels. Measure: lens area, 1/m².

    varies: whether the density depends on the pixel; else `pdf` takes any number of points. mixtures: the query itself where it
    draws from a mixture (`MixtureQuery`), else none.
    """

    varies = True
    mixtures: Sequence[Any] = ()

    def sample(self) -> LensPoints:
        """One lens point for each pixel, with its weight."""
        raise NotImplementedError

    def pdf(self, points: Tensor) -> Tensor:
        """Density `[N]` of `sample` at lens points `[2, N]`, one a pixel."""
        raise NotImplementedError

    def own_pdf(self, drawn: LensPoints) -> Tensor:
        """Density `[N]` at the points of `sample`."""
        return self.pdf(drawn.points)


@dataclass(frozen=True)
class StepSummary:
    """The state of the frame after a step.

    mean_luminance: of the frame so far. picture: mean radiance so far of the film's pixels, `[3, pixels]`, 0 in pixels of
    other ranks; a function, as few strategies ask for it.
    """

    step: int
    mean_luminance: float
    picture: Callable[[], Tensor]

    @property
    def ends_epoch(self) -> bool:
        """Whether the next step begins an epoch."""
        return starts_epoch(self.step + 1)


@dataclass
class LensRecord:
    """The report of one batch to its lens sampler. figures: guided pixels, their draws outside the lens, the sum of their β
    and the one-sample KL, float64 `[4]`; None where nothing is guided."""

    figures: Tensor | None = None


@dataclass(frozen=True)
class BatchSamples:
    """The samples of one batch.

    directions: of the camera rays, unit, world frame, `[3, N]`. lens_observers, light_observers: those of either strategy.
    film: the samples as the film takes them.
    """

    batch: PixelBatch
    query: LensQuery
    drawn: LensPoints
    directions: Tensor
    paths: PathSamples
    lens_observers: Sequence[PathObserver]
    light_observers: Sequence[PathObserver]
    film: FilmSamples


class Strategy(nn.Module):
    """A strategy of a mode. `accumulate` may run beside that of other strategies; `update` and `merge` are collective.

    learns: whether the strategy needs `accumulate` and `update`. A render whose strategies do not learn skips both.
    """

    learns = False

    def accumulate(self, records: Sequence[Any], summary: StepSummary) -> None:
        """Add the records of a step's batches, in the order of the pixels."""

    def update(self, summary: StepSummary) -> None:
        """End a step: learn from all records so far."""

    def merge(self) -> None:
        """Let every rank know the samples of all."""

    def check(self, step: int) -> None:
        """Raises ValueError for a loaded state that no render has after `step` steps."""


class LensSampler(Strategy):
    """Draws lens points, and may learn from the paths that begin there. This base class learns nothing.

    weighted: whether weights may differ from 1 where nothing is vignetted. paths_per_sample: mean number of paths of a sample.
    """

    weighted = True
    paths_per_sample = 1

    def __init__(self, context: ModeContext):
        super().__init__()
        self.camera, self.ranks = context.camera, context.ranks
        self.optimizers: dict[str, torch.optim.Optimizer] = {}

    def query(self, batch: PixelBatch) -> LensQuery:
        """The distribution of a batch. A query depends on earlier steps only."""
        raise NotImplementedError

    def initial_queries(self, batch: PixelBatch) -> Iterable[LensQuery]:
        """Queries whose samples initialise the film's features before the first sample counts."""
        return ()

    def is_independent(self, step: int) -> bool:
        """Whether the weights of a step are independent of the samples of earlier steps."""
        return True

    def splitting(self, weight: Tensor) -> Splitting:
        """How paths split at the primary hits of samples of these weights `[N]`."""
        return UNSPLIT

    def observers(self, batch: PixelBatch) -> Sequence[PathObserver]:
        """Observers of the batch's paths, made for `record`."""
        return ()

    def record(self, samples: BatchSamples, good: Tensor) -> LensRecord:
        """The report of a batch, for `accumulate`; good: samples that the film took, bool `[N]`. Threads call it side by side."""
        return LensRecord()

    def check(self, step: int) -> None:
        # Adam's fused step does not look at the sizes of its moments.
        for optimizer in self.optimizers.values():
            for parameter, state in optimizer.state.items():
                for name, moment in state.items():
                    shape = () if name == "step" else parameter.shape
                    if not isinstance(moment, Tensor) or moment.shape != shape or moment.dtype != torch.float32:
                        raise ValueError(f"{name} does not fit a parameter of {tuple(parameter.shape)}")

    @property
    def component_count(self) -> int:
        """Number of components of the learned field."""
        return 0

    def images(self, beta: Tensor) -> dict[str, Tensor]:
        """Pictures of the learned state, `[H, W, 3]` in 0 … 1, by name; beta: β of every pixel of the frame."""
        return {}

    def blend_weights(self) -> Tensor:
        """β of every pixel of the frame, `[pixels]`; 0 where nothing is guided."""
        return torch.zeros(self.camera.width * self.camera.height)


class LightStrategy(Strategy):
    """Chooses light samples at primary hits. This base class chooses by power, as the path tracer does by itself.

    sampler: the distribution of light samples by position, world frame (see `render/lights/base.py`).
    """

    sampler: LightSampler

    def __init__(self, context: ModeContext):
        super().__init__()
        self.sampler = context.tracer.light_sampler

    def observers(self) -> Sequence[PathObserver]:
        """Observers of a batch's paths, made for `record`."""
        return ()

    def record(self, samples: BatchSamples) -> object:
        """The report of a batch, for `accumulate`. Threads call it side by side."""
        return None


class SampleReuse(Strategy):
    """Lets pixels use each other's samples. This base class lets none.

    weighted: whether reused samples have weights other than 1.
    """

    weighted = False

    def cuts(self, width: int, height: int) -> np.ndarray | None:
        """Pixels of a film, ascending from 0 to their number, between which batches may be cut; None: between any two."""
        return None

    def expose(self, samples: BatchSamples, film: Callable[[Pixels, FilmSamples], Tensor], timer: PhaseTimer) -> Tensor:
        """Put a batch on the film, by calling `film`; returns the finite samples, bool `[N]`."""
        return film(samples.batch.places, samples.film)

    def second_pass(self, spans: Sequence[slice]) -> Sequence[slice]:
        """Spans of pixels that `resample` is called for after all batches of a step."""
        return ()

    def resample(self, span: slice, step: int, timer: PhaseTimer) -> tuple[FilmSamples, int]:
        """Final samples of a span of pixels, and the number of rays traced for them."""
        raise NotImplementedError


@dataclass
class Mode:
    """A way to render: how lens points are drawn, how lights are chosen at primary hits, how samples are reused."""

    lens: LensSampler
    lights: LightStrategy
    reuse: SampleReuse = field(default_factory=SampleReuse)

    @property
    def weighted(self) -> bool:
        """Whether samples may have weights other than 1 where nothing is vignetted."""
        return self.lens.weighted or self.reuse.weighted

    @property
    def strategies(self) -> Mapping[str, Strategy]:
        """The strategies by name, in the order of their updates."""
        return {"lens": self.lens, "lights": self.lights, "reuse": self.reuse}
