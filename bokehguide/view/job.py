"""One picture of the page, from a reduced size to its full size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from bokehguide.render import PathTracer
from bokehguide.scene import FilmSettings, Scene
from bokehguide.train import RenderLoop, RenderSettings, StepStats
from bokehguide.train.scheduler import Batches
from bokehguide.view.kept import Kept
from bokehguide.view.state import ViewState
from bokehguide.view.workers import StoppableWorkers

COARSE_PIXELS = 6_000
"""Approximate number of pixels of the first picture where nothing is known about the speed."""
BATCH_PIXELS, LEAST_BATCH = 3_600, 1_200
"""Pixels of a batch, and the least number of them. A change waits for the batches that have begun, some 30 ms. The batches change
no bit of the picture."""
PREVIEW_SPP = 32
"""Samples per pixel after which the picture rests, until a render is asked for."""

Window = tuple[int, int, int, int]
"""Left, top, width and height in pixels."""


def reduced_sizes(film: FilmSettings, pixels: float = COARSE_PIXELS) -> list[FilmSettings]:
    """Sizes of the film, each twice as wide as the one before, from one with about `pixels` pixels to its own."""
    count = max(0, round(math.log2(film.width * film.height / pixels) / 2.0))
    sizes = [(max(1, round(film.width / 2**n)), max(1, round(film.height / 2**n))) for n in range(count, 0, -1)]
    return [*(replace(film, width=width, height=height) for width, height in sizes), film]


def reduced_window(window: Window, width: int, film: FilmSettings) -> Window:
    """The window of a frame `width` pixels wide, in a reduced frame of the size of `film`; at least a pixel wide and high."""
    scale = film.width / width
    left, top = (min(int(start * scale), side - 1) for start, side in zip(window[:2], (film.width, film.height)))
    return (
        left,
        top,
        min(max(1, round(window[2] * scale)), film.width - left),
        min(max(1, round(window[3] * scale)), film.height - top),
    )


class Job:
    """The steps of the pictures of one traced state: one step at each reduced size, then the full size.

    scene: with the overrides of the state. tracer: of the scene. pixels: of the first picture, about. window: the part of the
    frame that is rendered, None for all. kept: learned state with which the full size begins; None: the job is exact. seed: of
    the full size where it begins with learned state, another one for each job. loop: of the present size. curve: numbers of steps
    and estimated MAPE at the full size. exact: whether the samples are those of the command line.
    """

    def __init__(
        self,
        scene: Scene,
        state: ViewState,
        tracer: PathTracer,
        workers: StoppableWorkers,
        pixels: float = COARSE_PIXELS,
        window: Window | None = None,
        kept: Kept | None = None,
        seed: int = 0,
    ):
        self.traced = state.traced
        self.scene, self.tracer = scene, tracer
        self._workers = workers
        self._kept, self._seed, self.exact = kept, seed, True
        self._settings = RenderSettings(state.mode, seed=state.seed, denoise=state.denoise)
        self._window = window
        seen = 1.0 if window is None else window[2] * window[3] / (scene.film.width * scene.film.height)
        self._sizes: Sequence[FilmSettings] = reduced_sizes(scene.film, pixels / seen)
        self.curve: list[tuple[int, float]] = []
        self.seconds = 0.0
        self.stats: StepStats | None = None
        self.loop = self._next_loop()
        self._sizes = self._sizes[1:]

    @property
    def full_size(self) -> bool:
        """Whether the loop has the full size."""
        return not self._sizes

    @property
    def at_first(self) -> bool:
        """Whether the next step makes the first of several pictures, which takes little time."""
        return not self.full_size and self.loop.step_number == 0

    @property
    def reduction(self) -> float:
        """Width of the full size over the present width."""
        return self.scene.film.width / self.loop.camera.width

    def done(self, spp: int) -> bool:
        """Whether the full size has `spp` samples per pixel."""
        return self.full_size and self.loop.step_number >= spp

    def serves(self, state: ViewState) -> bool:
        """Whether the picture is one of the state, without more samples than the state asks for."""
        return self.traced == state.traced and not self.done(state.spp + 1)

    def advance(self) -> StepStats:
        """Take a step, at the next size if this size has its step. Raises AbandonedError where the workers are stopped."""
        if not self.full_size and self.loop.step_number > 0:
            self.loop = self._next_loop()
            self._sizes = self._sizes[1:]  # last, for readers on other threads: they find no reduced loop at the full size
        self.stats = self.loop.step()
        self.seconds += self.stats.seconds
        return self.stats

    def measure(self) -> None:
        """Add the estimated error so far to the curve."""
        step = self.loop.step_number
        if self.full_size and step > 1 and (not self.curve or self.curve[-1][0] < step):
            self.curve.append((step, self.loop.film.relative_noise()))

    def _next_loop(self) -> RenderLoop:
        film, settings, learned = self._sizes[0], self._settings, None
        reduced = len(self._sizes) > 1
        if not reduced and self._kept is not None:
            learned = self._kept.learned(settings.mode, self.tracer)
        if learned is not None:
            settings, self.exact = replace(settings, seed=self._seed), False
        if self._window is not None:
            settings = replace(settings, crop=reduced_window(self._window, self.scene.film.width, film))
        loop = RenderLoop(replace(self.scene, film=film), settings, tracer=self.tracer)
        loop.workers = self._workers
        count = max(self._workers.threads, loop.film.width * loop.film.height // BATCH_PIXELS)
        loop.batches = Batches(count, loop.mode.lens.paths_per_sample, LEAST_BATCH)
        if learned is not None:
            loop.inherit(learned)
        if reduced:  # a reduced size has one step, so that nothing can use what it learns
            loop.freeze()
        return loop
