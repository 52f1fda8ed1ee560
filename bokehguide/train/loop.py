"""The render as a training loop: one SPP is one step."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bokehguide.errors import BokehguideError
from bokehguide.models.lens_distribution import LensDensity
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import Film, FilmSamples, earliest
from bokehguide.render.kernels import compile_kernels, kernel
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.pixels import Pixels, box_pixels, indices, pixel_numbers
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.transfers import own_stream, sent
from bokehguide.render.vector import luminance
from bokehguide.restir import SpatialReuse
from bokehguide.scene.types import Scene
from bokehguide.train.batches import Batches
from bokehguide.train.fitting import RADIANCE_THRESHOLD
from bokehguide.train.guide import LENS_DIMENSION, BatchLesson, GuidedBatch, LensDraw, LensGuide
from bokehguide.train.guide import guide_images, starts_block, uniform_draw
from bokehguide.train.light_guide import LightGuide
from bokehguide.train.memory import keep_freed_memory
from bokehguide.train.radiance_control import RadianceControl
from bokehguide.train.rank_sums import RankSums
from bokehguide.train.ranks import BAND, Ranks, available_cores
from bokehguide.train.record_buffer import FAR, Records
from bokehguide.train.settings import RenderSettings
from bokehguide.train.sharing import PathSharing
from bokehguide.train.spot_guide import PARTS, SpotGuide
from bokehguide.train.steps import BatchResult, StepStats, finite, guide_figures, step_stats

PRIMING_DIMENSION = LENS_DIMENSION + 5
"""Random dimensions of the lens points that prime the film: from this one on two."""
PHASES = ("tracing rays", "shading", "guiding", "learning", "output")


class RenderLoop:
    """Renders a scene step by step; after each step `film` holds the picture so far.

    Random numbers are keyed by pixel and what batches learn is added up in the pixels' order or in double precision,
    so where batches are cut, and on how many threads they run, changes nothing but the speed.

    ranks: the processes that share the work. Their Gaussians are the same, each knows the film and β of
    its own pixels, and all of them take every step, `picture` and `state_dict` together. tracer: that of another
    loop with the same scene and device.

    Raises BokehguideError for a crop that leaves the frame, and for Area ReSTIR on several ranks.
    """

    def __init__(
        self, scene: Scene, settings: RenderSettings, ranks: Ranks | None = None, tracer: PathTracer | None = None
    ):
        self.scene, self.settings, self.ranks = scene, settings, ranks or Ranks()
        if settings.reuses and not self.ranks.alone:
            raise BokehguideError(f"mode: {settings.mode} reuses samples of the whole frame; render it in one process")
        device = torch.device(settings.device)
        self.camera = ThinLensCamera(scene.camera, scene.film.width, scene.film.height, device)
        self.tracer = tracer or PathTracer(scene, device)
        self.film = self._empty_film()
        self._frame_pixels = box_pixels(settings.crop, self.camera.width).to(device) if settings.crop else None
        """Pixels of the frame that the film's are, int64 `[pixels]`; None where they are the same."""
        self._share = self.ranks.rows(self.film.width, self.film.height, BAND if settings.lens_mode == "guided" else 1, device)
        """Pixels of the film that are this rank's, int64 `[N]`; None where they all are."""
        self._places = self._share
        """Those that steps render."""
        pinhole = scene.camera.aperture_radius == 0.0
        guided = settings.lens_mode != "uniform" and not pinhole
        self.guide = self._make_guide() if guided else None
        self.light_guide: LightGuide | None = None
        if isinstance(self.guide, SpotGuide) and not self.tracer.lights.empty:
            self.light_guide = LightGuide(self.camera, self.tracer.lights.clusters.count, self.ranks)
        self.sharing: PathSharing | None = None
        self.control: RadianceControl | None = None
        if isinstance(self.guide, SpotGuide):
            self.sharing = PathSharing(self.camera, self.tracer, self.film.width, settings.seed)
        if self.sharing is not None and not self.camera.lens.vignettes:
            self.control = RadianceControl(self.film.width, self.film.height, device, self.ranks)
        self.reuse = SpatialReuse(self.camera, self.tracer, settings.reuse_radius, settings.seed) if settings.reuses else None
        self.step_number = 0
        self._threads = settings.threads or available_cores()
        self._batches = Batches(self._threads, PARTS if isinstance(self.guide, SpotGuide) else 1)
        # Threads work on batches. Those that torch would start inside operations only fight them.
        torch.set_num_threads(1)
        keep_freed_memory()
        compile_kernels(self._threads if settings.compile else 0)
        self._pool = ThreadPoolExecutor(self._threads, initializer=torch.set_num_threads, initargs=(1,))
        self._learns = guided
        self._phases: Counter[str] = Counter()
        self._mean_luminance = 1.0

    def _make_guide(self) -> LensGuide | SpotGuide:
        if self.settings.lens_mode == "guided":
            return SpotGuide(self.camera, self.scene, self.ranks)
        return LensGuide(self.camera, replace(self.settings, mode=self.settings.lens_mode), self.ranks)

    def _empty_film(self) -> Film:
        left, top, width, height = self.settings.window(self.camera.width, self.camera.height)
        device, vignettes = self.camera.position.device, self.camera.lens.vignettes
        weighted = self.settings.lens_mode != "uniform" or self.settings.reuses
        return Film(width, height, self.settings.seed, device, vignettes, weighted, (left, top))

    def render_only(self, active: Tensor) -> None:
        """From now on render those of the film's pixels that are `active`, bool `[pixels]`."""
        self._places = indices(active & self._mine_of_film().to(active.device))

    @property
    def phases(self) -> dict[str, float]:
        """Seconds of wall time so far by phase, all of PHASES."""
        return {phase: self._phases[phase] for phase in PHASES}

    def step(self) -> StepStats:
        """Render one more sample per pixel, and learn from it."""
        start = time.perf_counter()
        self.step_number += 1
        spans = self._spans()
        results = self._in_batches(self._render_batch, spans)
        reused = self._in_batches(self._reuse_batch, spans) if self.reuse is not None else []
        passes = [results, reused] if reused else [results]
        self._batches.cost([sum(part.samples + part.rays for part in parts) for parts in zip(*passes)])
        timer = PhaseTimer()
        if self._learns:
            with timer.measure("learning"):
                self._learn(results)
        self._phases += timer.seconds
        self.film.find_bad()
        gaussians = len(self.guide.field) if self.guide else 0
        return step_stats(self.step_number, results + reused, time.perf_counter() - start, gaussians, self.ranks)

    def _spans(self) -> list[slice]:
        """Spans of what steps render; where pixels share, of whole bands of rows."""
        size = self.film.width * self.film.height
        ends = None if self.sharing is None else np.append(np.arange(0, size, BAND * self.film.width), size)
        if self._places is not None:
            size = len(self._places)
            ends = None if ends is None else np.unique(np.searchsorted(self._places.cpu().numpy(), ends))
        return self._batches.spans(size, ends)

    def _in_batches(self, work: Callable[[Pixels], BatchResult], spans: list[slice]) -> list[BatchResult]:
        """What `work` returns for the film's pixels of each span of those that steps render."""
        start = time.perf_counter()
        places = self._places
        results = list(self._pool.map(self._beside(work), spans if places is None else [places[span] for span in spans]))
        worked = sum((result.timer.seconds for result in results), Counter())
        scale = (time.perf_counter() - start) / max(sum(worked.values()), 1e-9)
        self._phases += Counter({phase: seconds * scale for phase, seconds in worked.items()})
        return results

    def _beside(self, work: Callable[[Pixels], BatchResult]) -> Callable[[Pixels], BatchResult]:
        """`work`, beside that of other threads on a GPU as well."""

        def run(pixels: Pixels) -> BatchResult:
            with own_stream(self.camera.position.device):
                return work(pixels)

        return run

    @torch.no_grad()
    def _render_batch(self, places: Pixels) -> BatchResult:
        """One sample for each of some of the film's pixels: film position, lens point, ray, radiance, film."""
        timer = PhaseTimer()
        camera = self.camera
        with timer.measure("guiding"):
            pixels = places if self._frame_pixels is None else self._frame_pixels[places]
            numbers = pixel_numbers(pixels, self.settings.device)
            random = PixelRandom(self.settings.seed, self.step_number, numbers)
            corner = torch.stack((numbers % camera.width, numbers // camera.width))
            raster = corner + random.stratified(0, 2)
            focus = camera.focus_points(raster)
            draw = self._draw(pixels, raster, focus, random)
            points, weight, batch, at = draw
        with timer.measure("shading"):
            samples, directions = self._trace(focus, points, weight, random, timer)
            if self.step_number == 1 and self.guide is not None and self.guide.candidates is not None:
                samples.rays += self._prime(places, focus, random, timer)
            film_samples = self._film_samples(samples, directions, weight)
            if self.sharing is not None:
                film_samples = self._shared(places, focus, draw, samples, film_samples, timer)
        with timer.measure("output"):
            if self.reuse is None:
                good = self._expose(places, film_samples)
            else:
                good = self.reuse.keep(pixels, raster - corner, points, samples, film_samples)
        result = BatchResult(len(weight), samples.rays, timer)
        if not self._learns:
            return result
        with timer.measure("learning"):
            weight = weight.nan_to_num(0.0, 0.0, 0.0) * good
            result.lesson = self._study(batch, weight, finite(luminance(samples.radiance), good), at)
            recorded = finite(self.guide.recorded(samples), good)
            result.records = self._records(points, directions, self.guide.apparent_distance(samples), weight, recorded)
            result.figures = guide_figures(batch, weight, result.lesson)
            result.lights = samples.lights
        return result

    def _shared(
        self, places: Pixels, focus: Tensor, draw: LensDraw, samples: PathSamples, own: FilmSamples, timer: PhaseTimer
    ) -> FilmSamples:
        """The samples with what neighbours found in their radiance."""
        radiance, weight = self.sharing.share(self.step_number, places, focus, draw, samples, own.depth, timer)
        if self.control is not None:
            self.control.add(places, radiance, weight)
            radiance = radiance - self.control.slope(places) * (weight - 1.0)
        return replace(own, radiance=radiance, radiance_weight=torch.ones_like(weight))

    def _expose(self, places: Pixels, samples: FilmSamples) -> Tensor:
        """Put samples on the film; returns the finite ones, bool `[N]`."""
        fresh = self.guide is None or self.guide.is_fresh(self.step_number)
        return self.film.add(places, samples, self.step_number, fresh)

    @torch.no_grad()
    def _reuse_batch(self, pixels: slice) -> BatchResult:
        """The second pass of a step: some pixels choose among their samples and their neighbours'."""
        timer = PhaseTimer()
        film_samples, rays = self.reuse.resample(pixels, self.step_number, timer)
        with timer.measure("output"):
            self.film.add(pixels, film_samples, self.step_number)
        return BatchResult(0, rays, timer)

    def _prime(self, places: Pixels, focus: Tensor, random: PixelRandom, timer: PhaseTimer) -> int:
        """Tell the film what the uniform lens sees, before the first sample is weighed; returns the number of rays."""
        draw = uniform_draw(self.camera.lens, focus, random.uniform(PRIMING_DIMENSION, 2))
        origins, directions = self.camera.rays(focus, draw.points)
        seen = self.tracer.trace(origins, directions, random, timer, max_depth=1)
        self.film.prime(places, self._film_samples(seen, directions, draw.weight))
        return seen.rays

    def _draw(self, pixels: Pixels, raster: Tensor, focus: Tensor, random: PixelRandom) -> LensDraw:
        if self.guide is None:
            return uniform_draw(self.camera.lens, focus, random.uniform(LENS_DIMENSION, 2))
        return self.guide.draw(self.step_number, pixels, raster, focus, random)

    def _trace(
        self, focus: Tensor, points: Tensor, weight: Tensor, random: PixelRandom, timer: PhaseTimer
    ) -> tuple[PathSamples, Tensor]:
        """Radiance of the rays that pass the aperture, 0 for the others; world directions `[3, N]`."""
        choose = self.light_guide.choice if self.light_guide else None
        origins, directions = self.camera.rays(focus, points)
        parts = None if self.guide is None else self.guide.parts(weight)
        bright = 0.5 * RADIANCE_THRESHOLD * self._mean_luminance * (self.step_number > 1)  # it is not known before
        samples = self.tracer.trace(origins, directions, random, timer, choose=choose, alive=weight, parts=parts, bright=bright)
        return samples, directions

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

    def _records(self, points: Tensor, directions: Tensor, distance: Tensor, weight: Tensor, light: Tensor) -> Records:
        """What the record buffer is told of the samples inside the lens."""
        far = sent(FAR * self.camera.lens.focus_distance, distance.device, torch.float32)
        position = _positions(points, self.camera.axes.T @ directions, distance, far)
        cells = self.guide.record.cells(self.camera, position)
        return Records(torch.where(weight > 0.0, cells, -1), position, light)

    def _learn(self, results: list[BatchResult]) -> None:
        light, count = self.ranks.totals(*self._seen())
        self._mean_luminance = light / max(count, 1.0)
        records = [result.records for result in results]
        lights = [result.lights for result in results if result.lights is not None]
        remembered = self._pool.submit(self.guide.remember, records, self._mean_luminance)
        for each in lights:  # in the pixels' order, whatever the threads
            self.light_guide.add(*each)
        remembered.result()
        lessons = [result.lesson for result in results if result.lesson is not None]
        self.guide.update(self.step_number, lessons, self._mean_luminance)
        if starts_block(self.step_number + 1):
            if self.light_guide is not None:
                self.light_guide.update(self.step_number + 1)
            if self.control is not None:
                self.control.update(self._so_far() * self._mine_of_film().to(self.settings.device))

    def picture(self) -> Film:
        """The film with the pixels of all ranks; collective."""
        if self.ranks.alone:
            return self.film
        whole = self._empty_film()
        whole.load_state_dict(self._film_state())
        return whole

    def _film_state(self) -> dict[str, object]:
        state = self.ranks.merged(self.film.state_dict(), self._mine_of_film())
        found = self.ranks.gathered((self.film.bad_count, self.film.bad_samples))
        bad = earliest([bad for _, samples in found for bad in samples])
        return state | {"bad_count": sum(count for count, _ in found), "bad_samples": [tuple(each) for each in bad]}

    def _seen(self) -> tuple[float, float]:
        """Luminance of this rank's samples so far, and their number."""
        return self.film.light(slice(None) if self._share is None else self._share)

    def _so_far(self) -> Tensor:
        """What this rank has seen so far of each pixel of the film, on average, `[3, pixels]`."""
        return self.film.radiance().reshape(-1, 3).T

    def state_dict(self) -> dict[str, object]:
        """All that later steps depend on, and the times so far; collective.

        It is the same whatever the number of ranks, and tensors may be the loop's own, as in any state dict.
        """
        state = {"step": self.step_number, "film": self._film_state()}
        state |= {"mean_luminance": self._mean_luminance, "phases": dict(self._phases)}
        if self.guide is not None:
            self.guide.merge()
            optimizers = {name: optimizer.state_dict() for name, optimizer in self.guide.optimizers.items()}
            state |= self.ranks.merged({"guide": self.guide.state_dict(), "optimizers": optimizers}, self._mine())
        for name, learnt in self._learnt_sums():
            learnt.merge()
            state[name] = learnt.state_dict()
        return state

    def _learnt_sums(self) -> list[tuple[str, RankSums]]:
        """What is learnt beside the guide, by its name in state dicts."""
        found = (("light_guide", self.light_guide), ("control", self.control))
        return [(name, learnt) for name, learnt in found if learnt is not None]

    def _mine(self) -> Tensor:
        """Which pixels of the frame this rank answers for, bool `[pixels]`: the first one for those beyond a crop."""
        of_film = self._mine_of_film()
        if self._frame_pixels is None:
            return of_film
        of_frame = torch.full((self.camera.width * self.camera.height,), self.ranks.first)
        return of_frame.index_copy_(0, self._frame_pixels.cpu(), of_film)

    def _mine_of_film(self) -> Tensor:
        """Which pixels of the film this rank renders, bool `[pixels]`."""
        mine = torch.full((self.film.width * self.film.height,), self._share is None)
        if self._share is not None:
            mine[self._share.cpu()] = True
        return mine

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """Go on from the state of a loop of the same scene and settings (but SPP, threads and ranks): later steps
        have the same bits.

        Raises KeyError, RuntimeError or ValueError where it does not fit.
        """
        film = state["film"] if self.ranks.first else {**state["film"], "bad_count": 0, "bad_samples": []}
        self.film.load_state_dict(film)
        if self.guide is not None:
            learnt = dict(state["guide"])
            if "moments" in learnt and not self.ranks.alone:  # each rank adds up those of its own pixels
                learnt["moments"] = learnt["moments"] * self._mine()
            self.guide.load_state_dict(learnt)
            for name, optimizer in self.guide.optimizers.items():
                optimizer.load_state_dict(deepcopy(state["optimizers"][name]))  # it would share its tensors
        for name, learnt in self._learnt_sums():
            learnt.load_state_dict(state[name])
        guides = [guide for guide in (self.guide, self.light_guide) if guide is not None]
        if not all(1 <= int(guide.block) <= state["step"] + 1 for guide in guides):
            raise ValueError("a block of steps that has not begun")
        self.step_number, self._mean_luminance = state["step"], state["mean_luminance"]
        self._phases = Counter(state["phases"])

    def guide_images(self) -> dict[str, Tensor]:
        """Pictures of what the guide knows, `[H, W, 3]` in 0 … 1; none in uniform mode. Collective."""
        if self.guide is None:
            return {}
        beta = self.ranks.merged({"beta": self.guide.blend_weights()}, self._mine())["beta"]
        return guide_images(self.camera, self.guide.record, self.guide.spotlights, beta, self.guide.candidates)


@kernel
def _positions(points: Tensor, directions: Tensor, distance: Tensor, far: Tensor) -> Tensor:
    """Where rays from lens points `[2, N]` in directions `[3, N]` met something at `distance` `[N]`, camera frame `[3, N]`; of those
    that met nothing, that from the middle of the lens, and `far`."""
    hit = distance < MISS_DISTANCE
    origin = torch.stack((points[0] * hit, points[1] * hit, torch.zeros_like(distance)))
    return origin + directions * torch.where(hit, distance, far)
