"""The three strategies of a mode, and the data that a step of rendering passes to the strategies.

The stages of a step are pixels, focus points, lens query, lens points, rays, paths, reuse, film, record and update. A
`LensSampler` answers the lens query, a `LightStrategy` chooses light samples at primary hits, and a `SampleReuse` lets pixels use
samples of other pixels. The base classes learn nothing. A subclass overrides the methods that it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from bokehguide.errors import BokehguideError
from bokehguide.guiding.inheritance import Learned
from bokehguide.models.base import LensDensity
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.epochs import starts_epoch
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


def _missing(owner: object, method: str, returned: str) -> BokehguideError:
    """The error for a method that the class of `owner` must define. returned: the values that the method returns."""
    return BokehguideError(f"{type(owner).__name__}: the method {method} is missing; define it, to return {returned}")


@dataclass(frozen=True)
class ModeContext:
    """The arguments of the constructors of strategies.

    film_width, film_height: size of the rendered part of the frame, pixels. settings: the `RenderSettings` of the render. ranks:
    the processes of the render. owned: pixels of the frame for which this rank holds the learned state, bool `[pixels]`.
    """

    scene: Scene
    camera: ThinLensCamera
    tracer: PathTracer
    film_width: int
    film_height: int
    settings: Any
    ranks: Ranks
    owned: Tensor


class LensContext(Protocol):
    """The part of a `ModeContext` that lens samplers need."""

    @property
    def camera(self) -> ThinLensCamera: ...

    @property
    def ranks(self) -> Ranks: ...


@dataclass(frozen=True)
class PixelBatch:
    """N pixels in one step.

    places: indices of the pixels on the film. pixels: indices of the same pixels in the frame; a crop has a smaller film. raster:
    positions in the frame, pixels, `[2, N]`. subpixel: positions within the pixel, 0 to 1, `[2, N]`. focus: focus points x_F,
    camera frame, metres, `[3, N]`. random: random numbers of this step. mean_luminance: mean luminance of the frame before this
    step, 1 in the first step. grouped_random: random numbers of lens points, which the pixels of a group share (see
    `SampleReuse.share`); None without groups.
    """

    step: int
    places: Pixels
    pixels: Pixels
    raster: Tensor
    subpixel: Tensor
    focus: Tensor
    random: PixelRandom
    mean_luminance: float
    grouped_random: PixelRandom | None = None


class LensPoints(NamedTuple):
    """One lens point for each of N pixels.

    points: metres, float32 `[2, N]`. weight: W / (A q) of Eq. 11, 0 for a point that transmits no light, float32 `[N]`. at:
    densities of the mixture at the points, None without a mixture. candidate: candidate from which the point was drawn, int64
    `[N]`, -1 for the uniform part; None if the query does not report candidates.
    """

    points: Tensor
    weight: Tensor
    at: LensDensity | None = None
    candidate: Tensor | None = None


class LensQuery:
    """The distribution of lens points of one batch of pixels. Measure: lens area, 1/m².

    varies: whether the density depends on the pixel. If not, `pdf` takes any number of points.
    """

    varies = True

    def sample(self) -> LensPoints:
        """One lens point for each pixel, with its weight."""
        raise _missing(self, "sample()", "LensPoints")

    def pdf(self, points: Tensor) -> Tensor:
        """Density `[N]` of `sample` at lens points `[2, N]`, one for each pixel."""
        raise _missing(self, "pdf(points)", "densities")

    def own_pdf(self, drawn: LensPoints) -> Tensor:
        """Density `[N]` at the points that `sample` has drawn."""
        return self.pdf(drawn.points)


@dataclass(frozen=True)
class StepSummary:
    """The state of the frame after a step.

    mean_luminance: of the frame so far. picture: function that returns the mean radiance so far of the film's pixels,
    `[3, pixels]`, 0 in pixels of other ranks. groups: as `picture`, of the light groups, `[G, 3, pixels]`, None without groups.
    threads: number of threads on which strategies may work.
    """

    step: int
    mean_luminance: float
    picture: Callable[[], Tensor]
    groups: Callable[[], Tensor] | None = None
    threads: int = 1

    @property
    def ends_epoch(self) -> bool:
        """Whether the next step begins an epoch."""
        return starts_epoch(self.step + 1)


@dataclass
class LensRecord:
    """The report of one batch to its lens sampler.

    figures: number of guided pixels, number of their draws outside the lens, sum of their β, and one-sample KL, float64 `[4]`;
    None without guided pixels.
    """

    figures: Tensor | None = None


@dataclass(frozen=True)
class BatchSamples:
    """The samples of one batch.

    directions: unit directions of the camera rays, world frame, `[3, N]`. lens_observers, light_observers: observers of the lens
    sampler and of the light strategy. film: samples before reuse, in the form that the film adds.
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
    """Base class of strategies. Threads may call `accumulate` of different strategies concurrently.

    `update` and `merge` are collective: every rank calls them, in the same order.

    learns: whether the strategy needs `accumulate` and `update`. If no strategy learns, a render does not call the two methods.
    inherits: whether `inherit` does anything.
    """

    learns = False
    inherits = False

    def accumulate(self, records: Sequence[Any], summary: StepSummary) -> None:
        """Add the records of a step's batches, in the order of the pixels."""

    def update(self, summary: StepSummary) -> None:
        """End a step: learn from all reports so far. Collective."""

    def merge(self) -> None:
        """Exchange the samples of all ranks. Collective."""

    def inherit(self, learned: Learned, name: str) -> None:
        """Begin with the learned state of an earlier render, before the first step; `name` of this strategy in its state."""

    def check(self, step: int) -> None:
        """Raises ValueError if no render can have the loaded state after `step` steps."""


class LensSampler(Strategy):
    """Draws lens points, and may learn from the paths that begin at these points. This base class learns nothing.

    weighted: whether weights may differ from 1 without vignetting. paths_per_sample: approximate number of paths of a sample.
    """

    weighted = True
    paths_per_sample = 1

    def __init__(self, context: LensContext):
        super().__init__()
        self.camera, self.ranks = context.camera, context.ranks
        self.optimizers: dict[str, torch.optim.Optimizer] = {}

    def query(self, batch: PixelBatch) -> LensQuery:
        """The lens distribution of a batch. The distribution depends only on earlier steps."""
        raise _missing(self, "query(batch)", "a LensQuery")

    def initial_queries(self, batch: PixelBatch) -> Iterable[LensQuery]:
        """Queries whose samples initialise the control variates of the film's features. These samples are not in the picture."""
        return ()

    def is_independent(self, step: int) -> bool:
        """Whether the weights of a step are independent of the samples of earlier steps."""
        return True

    def splitting(self, weight: Tensor) -> Splitting:
        """Strategy by which paths split at the primary hits of samples with the weights `[N]`."""
        return UNSPLIT

    def observers(self, batch: PixelBatch) -> Sequence[PathObserver]:
        """Observers of the batch's paths, for use by `record`."""
        return ()

    def record(self, samples: BatchSamples, good: Tensor) -> LensRecord:
        """The report of a batch, for `accumulate`. Threads call this method concurrently.

        good: whether a sample is finite and on the film, bool `[N]`.
        """
        return LensRecord()

    def check(self, step: int) -> None:
        # Adam's fused step does not check the sizes of its moments.
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
        """β of every pixel of the frame, `[pixels]`; 0 without guiding."""
        return torch.zeros(self.camera.width * self.camera.height)


class LightStrategy(Strategy):
    """Chooses light samples at primary hits. This base class chooses by power, like all later vertices of the path tracer.

    sampler: the distribution of light samples by position, world frame (see `render/lights/base.py`).
    """

    sampler: LightSampler

    def __init__(self, context: ModeContext):
        super().__init__()
        self.sampler = context.tracer.light_sampler

    def observers(self) -> Sequence[PathObserver]:
        """Observers of a batch's paths, for use by `record`."""
        return ()

    def record(self, samples: BatchSamples) -> object:
        """The report of a batch, for `accumulate`. Threads call this method concurrently."""
        return None


class SampleReuse(Strategy):
    """Lets pixels use samples of other pixels. In this base class, a pixel uses only its own sample.

    weighted: whether reused samples may have weights other than 1. roulette_cell: cells of the roulette of shadow rays (see
    `ShadowRoulette`).
    """

    weighted = False
    roulette_cell = 1

    def cuts(self, width: int, height: int) -> np.ndarray | None:
        """Pixel numbers at which a film may be cut into batches, ascending from 0 to the number of pixels; None: all."""
        return None

    def share(self, random: PixelRandom, places: Pixels, step: int) -> PixelRandom | None:
        """Random numbers of the lens points of a batch, from those of its pixels, if pixels that reuse each other's samples share
        a sequence of numbers; else None."""
        return None

    def expose(self, samples: BatchSamples, film: Callable[[Pixels, FilmSamples], Tensor], timer: PhaseTimer) -> Tensor:
        """Add a batch to the film by calling `film`; returns whether samples are finite, bool `[N]`."""
        return film(samples.batch.places, samples.film)

    def second_pass(self, spans: Sequence[slice]) -> Sequence[slice]:
        """Spans of pixels for which the loop calls `resample` after all batches of a step."""
        return ()

    def resample(self, span: slice, step: int, timer: PhaseTimer) -> tuple[FilmSamples, int]:
        """Final samples of a span of pixels, and the number of rays traced for them."""
        raise _missing(self, "resample(span, step, timer)", "FilmSamples and a ray count")


@dataclass
class Mode:
    """The three strategies of a render: for lens points, for light samples at primary hits, and for the reuse of samples."""

    lens: LensSampler
    lights: LightStrategy
    reuse: SampleReuse = field(default_factory=SampleReuse)

    @property
    def weighted(self) -> bool:
        """Whether samples may have weights other than 1 without vignetting."""
        return self.lens.weighted or self.reuse.weighted

    @property
    def strategies(self) -> Mapping[str, Strategy]:
        """The strategies by name, in the order of their updates."""
        return {"lens": self.lens, "lights": self.lights, "reuse": self.reuse}
