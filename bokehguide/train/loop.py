"""The render as a training loop: one SPP is one step."""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bokehguide.models.lens_distribution import LensDensity
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import Film, FilmSamples
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import luminance
from bokehguide.restir import SpatialReuse
from bokehguide.scene.types import Scene
from bokehguide.train.guide import LENS_DIMENSION, BatchLesson, GuidedBatch, LensDraw, LensGuide, uniform_draw
from bokehguide.train.record_buffer import FAR
from bokehguide.train.settings import RenderSettings
from bokehguide.train.spot_guide import SpotGuide

BATCH = 65536
"""Pixels traced together at most: more would leave the cache."""
SMALL_BATCH, FEW_BATCHES = 28800, 4
"""A small frame is cut into up to four batches, so that threads have work, but none smaller than
this: below it Python costs more than a second thread brings."""
PRIMING_DIMENSION = LENS_DIMENSION + 5
"""Random dimensions of the lens points that prime the film: from this one on two."""
PHASES = ("tracing rays", "shading", "guiding", "learning", "output")


@dataclass
class StepStats:
    """What a step did; kl, beta and outside are NaN where nothing was guided."""

    step: int
    samples: int
    rays: int
    seconds: float
    kl: float
    beta: float
    gaussians: int
    outside: float


@dataclass
class _BatchResult:
    rays: int
    guided: int
    outside: int
    beta: float
    lesson: BatchLesson | None
    records: tuple[Tensor, Tensor, Tensor] | None
    timer: PhaseTimer


class RenderLoop:
    """Renders a scene step by step; after each step `film` holds the picture so far.

    Batches are cut by the frame's size alone and random numbers are keyed by pixel, so the
    number of threads changes nothing but the speed.
    """

    def __init__(self, scene: Scene, settings: RenderSettings):
        self.scene, self.settings = scene, settings
        device = torch.device(settings.device)
        width, height = scene.film.width, scene.film.height
        self.camera = ThinLensCamera(scene.camera, width, height, device)
        self.tracer = PathTracer(scene, device)
        self.film = Film(width, height, settings.seed, device, self.camera.lens.vignettes)
        pinhole = scene.camera.aperture_radius == 0.0
        guided = settings.lens_mode != "uniform" and not pinhole
        self.guide = self._make_guide() if guided else None
        self.reuse = SpatialReuse(self.camera, self.tracer, settings.reuse_radius, settings.seed) if settings.reuses else None
        self.step_number = 0
        self._threads = settings.threads or _available_cores()
        # Threads work on batches. Those that torch would start inside operations only fight them.
        torch.set_num_threads(1)
        self._pool = ThreadPoolExecutor(self._threads, initializer=torch.set_num_threads, initargs=(1,))
        self._phases: Counter[str] = Counter()
        self._mean_luminance = 1.0

    def _make_guide(self) -> LensGuide | SpotGuide:
        if self.settings.lens_mode == "guided":
            return SpotGuide(self.camera, self.scene)
        return LensGuide(self.camera, replace(self.settings, mode=self.settings.lens_mode))

    @property
    def phases(self) -> dict[str, float]:
        """Seconds of wall time so far by phase, all of PHASES."""
        return {phase: self._phases[phase] for phase in PHASES}

    def step(self) -> StepStats:
        """Render one more sample per pixel, and learn from it."""
        start = time.perf_counter()
        self.step_number += 1
        results = self._in_batches(self._render_batch)
        reused = self._in_batches(self._reuse_batch) if self.reuse is not None else []
        timer = PhaseTimer()
        if self.guide is not None:
            with timer.measure("learning"):
                self._learn(results)
        self._phases += timer.seconds
        return self._stats(results + reused, time.perf_counter() - start)

    def _in_batches(self, work: Callable[[int, int], _BatchResult]) -> list[_BatchResult]:
        """What `work` returns for the pixels from … to … of each batch."""
        start = time.perf_counter()
        pixels = self.camera.width * self.camera.height
        count = max(math.ceil(pixels / BATCH), min(FEW_BATCHES, pixels // SMALL_BATCH), 1)
        size = math.ceil(pixels / count)
        spans = [(first, min(first + size, pixels)) for first in range(0, pixels, size)]
        results = list(self._pool.map(lambda span: work(*span), spans))
        worked = sum((result.timer.seconds for result in results), Counter())
        scale = (time.perf_counter() - start) / max(sum(worked.values()), 1e-9)
        self._phases += Counter({phase: seconds * scale for phase, seconds in worked.items()})
        return results

    @torch.no_grad()
    def _render_batch(self, first: int, end: int) -> _BatchResult:
        """One sample for each of some pixels: film position, lens point, ray, radiance, film."""
        timer = PhaseTimer()
        camera = self.camera
        with timer.measure("guiding"):
            pixels = torch.arange(first, end, device=self.settings.device)
            random = PixelRandom(self.settings.seed, self.step_number, pixels)
            corner = torch.stack((pixels % camera.width, pixels // camera.width))
            raster = corner + random.stratified(0, 2)
            focus = camera.focus_points(raster)
            points, weight, batch, at = self._draw(first, raster, focus, random)
        with timer.measure("shading"):
            samples, directions = self._trace(focus, points, weight, random, timer)
            if self.step_number == 1 and batch is not None:
                samples.rays += self._prime(first, focus, random, timer)
        with timer.measure("output"):
            film_samples = self._film_samples(samples, directions, weight)
            if self.reuse is None:
                fresh = self.guide is None or self.guide.is_fresh(self.step_number)
                good = self.film.add(first, film_samples, self.step_number, fresh)
            else:
                good = self.reuse.keep(first, raster - corner, points, samples, film_samples)
        if self.guide is None:
            return _BatchResult(samples.rays, 0, 0, 0.0, None, None, timer)
        with timer.measure("learning"):
            weight = weight.nan_to_num(0.0, 0.0, 0.0) * good
            lesson = self._study(batch, weight, _finite(luminance(samples.radiance), good), at)
            recorded = _finite(self.guide.recorded(samples), good)
            records = self._records(points, directions, samples.distance, weight, recorded)
        guided, outside, beta = _count(batch, weight)
        return _BatchResult(samples.rays, guided, outside, beta, lesson, records, timer)

    @torch.no_grad()
    def _reuse_batch(self, first: int, end: int) -> _BatchResult:
        """The second pass of a step: some pixels choose among their samples and their neighbours'."""
        timer = PhaseTimer()
        film_samples, rays = self.reuse.resample(first, end, self.step_number, timer)
        with timer.measure("output"):
            self.film.add(first, film_samples, self.step_number)
        return _BatchResult(rays, 0, 0, 0.0, None, None, timer)

    def _prime(self, first: int, focus: Tensor, random: PixelRandom, timer: PhaseTimer) -> int:
        """Tell the film what the uniform lens sees, before the first sample is weighed; returns the number of rays."""
        draw = uniform_draw(self.camera.lens, focus, random.uniform(PRIMING_DIMENSION, 2))
        origins, directions = self.camera.rays(focus, draw.points)
        seen = self.tracer.trace(origins, directions, random, timer, max_depth=1)
        self.film.prime(first, self._film_samples(seen, directions, draw.weight))
        return seen.rays

    def _draw(self, first: int, raster: Tensor, focus: Tensor, random: PixelRandom) -> LensDraw:
        if self.guide is None:
            return uniform_draw(self.camera.lens, focus, random.uniform(LENS_DIMENSION, 2))
        return self.guide.draw(self.step_number, first, raster, focus, random)

    def _trace(
        self, focus: Tensor, points: Tensor, weight: Tensor, random: PixelRandom, timer: PhaseTimer
    ) -> tuple[PathSamples, Tensor]:
        """Radiance of the rays that pass the aperture, 0 for the others; world directions `[3, N]`."""
        origins, directions = self.camera.rays(focus, points)
        inside = (weight > 0.0).nonzero()[:, 0]
        if len(inside) == len(weight):
            return self.tracer.trace(origins, directions, random, timer), directions
        traced = self.tracer.trace(origins[:, inside], directions[:, inside], random.select(inside), timer)
        return traced.spread(inside, len(weight)), directions

    def _film_samples(self, samples: PathSamples, directions: Tensor, weight: Tensor) -> FilmSamples:
        depth = self.camera.depth(samples.distance, directions)
        return FilmSamples(
            weight, samples.radiance, samples.alpha, depth, samples.normal, samples.albedo, samples.emission
        )

    def _study(
        self, batch: GuidedBatch | None, weight: Tensor, light: Tensor, at: LensDensity | None
    ) -> BatchLesson | None:
        """Gradients of the one-sample KL; radiance counts in units of the frame's mean, and for nothing while that is 0."""
        if batch is None:
            return None
        unit = self._mean_luminance or math.inf
        return self.guide.study(batch, light * weight / unit, at)

    def _records(self, points: Tensor, directions: Tensor, distance: Tensor, weight: Tensor, light: Tensor):
        """Cells, camera-frame positions and luminance of the samples inside the lens, for the record buffer."""
        away = self.camera.axes.T @ directions
        hit = distance < MISS_DISTANCE
        origin = torch.cat((points, torch.zeros_like(points[:1]))) * hit
        reach = torch.where(hit, distance, FAR * self.camera.lens.focus_distance)
        position = origin + away * reach
        cells = self.guide.record.cells(self.camera, position)
        return torch.where(weight > 0.0, cells, -1), position, light

    def _learn(self, results: list[_BatchResult]) -> None:
        for result in results:
            self.guide.record.add(*result.records)
        self._mean_luminance = self.film.mean_luminance()
        lessons = [result.lesson for result in results if result.lesson is not None]
        self.guide.update(self.step_number, lessons, self._mean_luminance)

    def _stats(self, results: list[_BatchResult], seconds: float) -> StepStats:
        guided = sum(result.guided for result in results)
        samples = self.camera.width * self.camera.height
        kl = sum(result.lesson.kl for result in results if result.lesson is not None)
        return StepStats(
            step=self.step_number,
            samples=samples,
            rays=sum(result.rays for result in results),
            seconds=seconds,
            kl=kl / guided if guided else math.nan,
            beta=sum(result.beta for result in results) / guided if guided else math.nan,
            gaussians=len(self.guide.field) if self.guide else 0,
            outside=sum(result.outside for result in results) / guided if guided else math.nan,
        )

    def state_dict(self) -> dict[str, object]:
        """All that later steps depend on, and the times so far; tensors are the loop's own, as in any state dict."""
        state = {"step": self.step_number, "film": self.film.state_dict()}
        state |= {"mean_luminance": self._mean_luminance, "phases": dict(self._phases)}
        if self.guide is not None:
            optimizers = {name: optimizer.state_dict() for name, optimizer in self.guide.optimizers.items()}
            state |= {"guide": self.guide.state_dict(), "optimizers": optimizers}
        return state

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """Go on from the state of a loop of the same scene and settings (but SPP and threads): later steps have the same bits.

        Raises KeyError, RuntimeError or ValueError where it does not fit.
        """
        self.film.load_state_dict(state["film"])
        if self.guide is not None:
            self.guide.load_state_dict(state["guide"])
            for name, optimizer in self.guide.optimizers.items():
                optimizer.load_state_dict(deepcopy(state["optimizers"][name]))  # it would share its tensors
        self.step_number, self._mean_luminance = state["step"], state["mean_luminance"]
        self._phases = Counter(state["phases"])

    def guide_images(self) -> dict[str, Tensor]:
        """Pictures of what the guide knows, `[H, W, 3]` in 0 … 1; none in uniform mode."""
        return self.guide.images() if self.guide else {}


def _finite(light: Tensor, good: Tensor) -> Tensor:
    """Luminance `[N]` of the samples that the film took, 0 for the others."""
    return light.nan_to_num(0.0, 0.0, 0.0) * good


def _available_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _count(batch: GuidedBatch | None, weight: Tensor) -> tuple[int, int, float]:
    """Guided pixels, draws outside the lens, and the sum of β."""
    if batch is None:
        return 0, 0, 0.0
    mixture = batch.distribution
    return int(mixture.guided.sum()), int(((weight == 0.0) & mixture.guided).sum()), float(mixture.beta.sum())
