"""The render as a training loop: one SPP is one step."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any, cast

import torch
from torch import Tensor

from bokehguide.errors import BokehguideError
from bokehguide.guiding.inheritance import Learned
from bokehguide.guiding.modes import MODES
from bokehguide.guiding.protocols import ModeContext, PixelBatch, StepSummary
from bokehguide.render.bad_samples import earliest
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.epochs import starts_epoch
from bokehguide.render.features import ControlVariateFeatures, MeanFeatures, RatioFeatures
from bokehguide.render.film import Film, FilmSamples
from bokehguide.render.light_groups import GroupedLights
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.shadow_roulette import ShadowRoulette
from bokehguide.render.split_film import SplitFilm
from bokehguide.runtime.device import free_memory
from bokehguide.runtime.distributed import Ranks, available_cores
from bokehguide.runtime.indexing import Pixels
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.runtime.workers import Workers
from bokehguide.scene.light_groups import find_light_groups
from bokehguide.scene.types import Scene
from bokehguide.train.batch_tracer import BatchTracer
from bokehguide.train.film_pixels import FilmPixels
from bokehguide.train.lens_draws import draw
from bokehguide.train.loop_base import Loop, require_inputs
from bokehguide.train.loop_state import all_or_nothing, require_loop_state, require_one_moment
from bokehguide.train.mattes import triangle_objects
from bokehguide.train.scheduler import GPU_THREADS, Batches
from bokehguide.train.settings import RenderSettings
from bokehguide.train.step_stats import BatchResult, StepStats, step_stats

PHASES = ("tracing rays", "shading", "guiding", "learning", "output")


class RenderLoop(Loop):
    """Renders a scene step by step. After each step, `film` holds the picture so far.

    The loop is a context manager that ends its worker threads.
    `workers` and `batches`, which cuts the pixels of a step, may be replaced before the first step. `pixels` are the pixels that
    steps render.
    Random numbers depend on the pixel, and the loop adds reports of batches in the order of the pixels or in double precision.
    The batches and the number of threads therefore change no bit.

    ranks: processes that render the picture together. All ranks have the same learned state, but each rank has the film and β of
    its own pixels. All ranks must call `step`, `picture` and `state_dict` together. tracer: `PathTracer` of another loop with the
    same scene and device, to be used again.

    Raises BokehguideError for a crop that leaves the frame, for a mode that needs the whole frame on several ranks, and for light
    groups of a scene without any.
    """

    def __init__(self, scene: Scene, settings: RenderSettings, ranks: Ranks | None = None, tracer: PathTracer | None = None):
        require_inputs(scene, settings)
        self.scene, self.settings, self.ranks = scene, settings, ranks or Ranks()
        entry, device = MODES[settings.mode], torch.device(settings.device)
        threads, on_cpu = settings.threads or available_cores(), device.type == "cpu"
        if entry.whole_frame and not self.ranks.alone:
            raise BokehguideError(f"mode: {settings.mode} reuses samples of the whole frame; render it in one process")
        self.camera = ThinLensCamera(scene.camera, scene.film.width, scene.film.height, device)
        self.tracer = tracer or PathTracer(scene, device, threads=1 if on_cpu else threads)
        window = *_, width, height = settings.window(self.camera.width, self.camera.height)
        self.pixels = FilmPixels(self.camera, window, self.ranks, entry.rows_per_band, device)
        owned = self.pixels.mine_in_frame()
        context = ModeContext(scene, self.camera, self.tracer, width, height, settings, self.ranks, owned)
        self._groups = find_light_groups(scene) if settings.light_groups else None
        self.mode = entry.build(context)
        self.film = self._empty_film()
        self.shadow_roulette = ShadowRoulette(width, height, self.mode.reuse.roulette_cell, device)
        grouped = GroupedLights(self._groups, self.tracer.geometry, self.tracer.lights) if self._groups else None
        self._batch_tracer = BatchTracer(self.camera, self.tracer, self.mode, self.shadow_roulette, grouped)
        self.step_number = 0
        paths = self.mode.lens.paths_per_sample
        self.workers = Workers(threads if on_cpu else GPU_THREADS, device)
        self.batches = Batches(threads, paths) if on_cpu else Batches.on_gpu(free_memory(device), paths)
        self._learns = any(strategy.learns for strategy in self.mode.strategies.values())
        self._phases: Counter[str] = Counter()
        self._mean_luminance = 1.0
        self._has_stepped = False
        """Whether a step has ended; an abandoned step leaves nothing to hand on."""
        self._unlearned: Sequence[BatchResult] | None = None
        """Reports of the last step, empty on a rank without pixels; None once the strategies have learned from the step."""

    def _empty_film(self) -> Film:
        pixels = self.pixels
        features: type[MeanFeatures] = MeanFeatures
        if self.camera.lens.vignettes:
            features = RatioFeatures
        elif self.mode.weighted:
            features = ControlVariateFeatures
        objects = triangle_objects(self.scene) if self.settings.cryptomatte else None
        groups = self._groups.names if self._groups else ()
        device = self.camera.position.device
        film = self._film_class()
        return film(pixels.width, pixels.height, self.settings.seed, device, features, pixels.corner, objects, groups)

    def _film_class(self) -> type[Film]:
        return SplitFilm if self.settings.denoise else Film

    def learned(self) -> Learned | None:
        """What the strategies have learned, for `inherit`; None if they cannot hand it on, and before the end of the first step.

        The tensors are those of the loop.
        """
        strategies = self.mode.strategies
        if not self._has_stepped or not any(strategy.inherits for strategy in strategies.values()):
            return None
        with self.workers.serial():
            self._learn()
            for strategy in strategies.values():
                strategy.merge()
        state = {name: strategy.state_dict() for name, strategy in strategies.items()}
        depth = torch.from_numpy(self.film.layers()["depth"]).flatten()
        return Learned(state, self.camera, depth, self.step_number, self._mean_luminance)

    def inherit(self, learned: Learned) -> None:
        """Begin with the learned state of a render of the same scene and mode, with another camera, lens and seed, but on one
        rank, of the whole frame and of the same size. Call this method before the first step.

        A strategy that learned nothing in the earlier render, such as the lens of a pinhole, begins anew."""
        with self.workers.serial():
            for name, strategy in self.mode.strategies.items():
                if strategy.inherits and learned.state[name]:
                    strategy.inherit(learned, name)

    def freeze(self) -> None:
        """Stop learning."""
        self._learn()
        self._learns = False

    def render_only(self, active: Tensor) -> None:
        """From now on, render only the `active` pixels of the film, bool `[pixels]`."""
        self.pixels.render_only(active)

    @property
    def complete(self) -> bool:
        """Whether the render has all its SPP."""
        return self.step_number >= self.settings.spp

    @property
    def phases(self) -> dict[str, float]:
        """Seconds of wall time so far, for each phase in PHASES."""
        return {phase: self._phases[phase] for phase in PHASES}

    def step(self, last: bool = False) -> StepStats:
        """Render one more sample per pixel, and learn from it.

        last: whether no other step is expected. The loop then learns from this step only when its state is needed before `close`.
        """
        start = time.perf_counter()
        self._require_open()
        with self.workers.serial():
            self._learn()
            self.step_number += 1
            if starts_epoch(self.step_number):
                self._update_roulette()
            spans = self._spans()
            results = self._in_batches(self._render_batch, spans)
            resampled = self._in_batches(self._resample_batch, self.mode.reuse.second_pass(spans))
            self.batches.took([sum(times) for times in zip(*(_seconds(each) for each in (results, resampled) if each))])
            if self._learns:
                self._unlearned = results
                if not last:
                    self._learn()
            self.film.find_bad()
            self._has_stepped = True
            seconds, components = time.perf_counter() - start, self.mode.lens.component_count
            return step_stats(self.step_number, results + resampled, seconds, components, self.ranks)

    def _require_open(self) -> None:
        """Raise BokehguideError after `close`."""
        if self.workers.closed:
            raise BokehguideError("RenderLoop.step: the loop is closed; take all steps in its `with` block, or make another loop")

    def _update_roulette(self) -> None:
        """Compute the thresholds of shadow rays from the samples on the film."""
        self.shadow_roulette.update(self.film)

    def _spans(self) -> list[slice]:
        """Spans of the pixels that steps render."""
        cuts = self.mode.reuse.cuts(self.film.width, self.film.height)
        return self.batches.spans(*self.pixels.row(cuts))

    def _in_batches(self, work: Callable[[Pixels], BatchResult], spans: Sequence[slice]) -> list[BatchResult]:
        """Results of `work` for the film's pixels of each span."""
        start = time.perf_counter()
        results = self.workers.map(work, [self.pixels.at(span) for span in spans])
        worked = sum((result.timer.seconds for result in results), Counter())
        scale = (time.perf_counter() - start) / max(sum(worked.values()), 1e-9)
        self._phases += Counter({phase: seconds * scale for phase, seconds in worked.items()})
        return results

    @torch.no_grad()
    def _render_batch(self, places: Pixels) -> BatchResult:
        """One sample for each of the given pixels of the film."""
        mode, timer = self.mode, PhaseTimer()
        with timer.measure("guiding"):
            batch = self._pixels(places)  # pixels and focus points
            query = mode.lens.query(batch)
            drawn = draw(self.settings.mode, query, batch.focus)
        with timer.measure("shading"):
            rays = self._initialise(batch, timer)
            samples = self._batch_tracer.trace(batch, query, drawn, timer)  # rays and paths
            good = mode.reuse.expose(samples, self._film_sink(timer), timer)
        result = BatchResult(len(drawn.weight), samples.paths.rays + rays, timer)
        if self._learns:
            with timer.measure("learning"):
                result.lens = mode.lens.record(samples, good)
                result.lights = mode.lights.record(samples)
        return result

    def _pixels(self, places: Pixels) -> PixelBatch:
        """Pixels of the film with their jittered raster positions and focus points."""
        pixels = self.pixels.in_frame(places)
        random = PixelRandom(self.settings.seed, self.step_number, pixels, self.settings.device)
        positions = self.camera.film_positions(pixels, random)
        grouped = self.mode.reuse.share(random, places, self.step_number)
        return PixelBatch(self.step_number, places, pixels, *positions, random, self._mean_luminance, grouped)

    def _initialise(self, batch: PixelBatch, timer: PhaseTimer) -> int:
        """Initialise the film's features with samples that are not in the picture; returns the number of rays."""
        rays = 0
        for query in self.mode.lens.initial_queries(batch):
            drawn = draw(self.settings.mode, query, batch.focus)
            samples, traced = self._batch_tracer.trace_features(batch, drawn, timer)
            self.film.initialise(batch.places, samples)
            rays += traced
        return rays

    def _film_sink(self, timer: PhaseTimer) -> Callable[[Pixels, FilmSamples], Tensor]:
        """The function that puts samples on the film and returns the finite ones, bool `[N]`."""

        def expose(places: Pixels, samples: FilmSamples) -> Tensor:
            with timer.measure("output"):
                return self._expose(places, samples)

        return expose

    def _expose(self, places: Pixels, samples: FilmSamples) -> Tensor:
        return self.film.add(places, samples, self.step_number, self.mode.lens.is_independent(self.step_number))

    @torch.no_grad()
    def _resample_batch(self, pixels: Pixels) -> BatchResult:
        """The second pass of a step, where the mode has one."""
        timer = PhaseTimer()
        samples, rays = self.mode.reuse.resample(cast(slice, pixels), self.step_number, timer)
        with timer.measure("output"):
            self.film.add(pixels, samples, self.step_number)
        return BatchResult(0, rays, timer)

    def _learn(self) -> None:
        """Learn from the last step, unless this is done. Collective."""
        results, self._unlearned = self._unlearned, None
        if results is not None:
            timer = PhaseTimer()
            with timer.measure("learning"):
                self._learn_from(results)
            self._phases += timer.seconds

    def _learn_from(self, results: Sequence[BatchResult]) -> None:
        """Pass the reports of all batches to the strategies, and end the step of the strategies."""
        light, count = self.ranks.totals(*self._light_so_far())
        self._mean_luminance = max(light, 0.0) / max(count, 1.0)  # a control variate may leave a negative sum on few pixels
        groups = self._groups_so_far if self._groups else None
        summary = StepSummary(self.step_number, self._mean_luminance, self._picture_so_far, groups, self.workers.threads)
        recorded = self.workers.submit(self.mode.lens.accumulate, [result.lens for result in results], summary)
        # Light samples come in the order of the pixels, whatever the threads.
        self.mode.lights.accumulate([result.lights for result in results], summary)
        recorded.result()
        for result in results:
            result.release()
        for strategy in self.mode.strategies.values():
            strategy.update(summary)

    def _light_so_far(self) -> tuple[float, float]:
        """Luminance of this rank's samples so far, and their number."""
        return self.film.light(self.pixels.own)

    def _picture_so_far(self) -> Tensor:
        """Mean radiance so far of the film's pixels, `[3, pixels]`, 0 in pixels of other ranks."""
        return self.film.radiance().reshape(-1, 3).T.mul_(self.pixels.mine.to(self.settings.device))

    def _groups_so_far(self) -> Tensor:
        """As `_picture_so_far`, of the light groups, `[G, 3, pixels]`."""
        return self.film.group_radiance() * self.pixels.mine.to(self.settings.device)

    def picture(self) -> Film:
        """The film with the pixels of all ranks; collective."""
        if self.ranks.alone:
            return self.film
        whole = self._empty_film()
        whole.load_state_dict(self._film_state())
        return whole

    def _film_state(self) -> dict[str, object]:
        state = self.ranks.merged(self.film.state_dict(), self.pixels.mine)
        found = self.ranks.gathered((self.film.bad_count, self.film.bad_samples))
        bad = earliest([bad for _, samples in found for bad in samples])
        return state | {"bad_count": sum(count for count, _ in found), "bad_samples": [tuple(each) for each in bad]}

    def state_dict(self) -> dict[str, object]:
        """All values on which later steps depend, and the times so far; collective.

        The state does not depend on the number of ranks. Its tensors may be the tensors of the loop, as in any state dict of
        PyTorch. Later steps change these tensors: `copy.deepcopy` keeps the state of a moment.
        """
        with self.workers.serial():
            self._learn()
            size = [self.film.width, self.film.height]
            state: dict[str, object] = {"step": self.step_number, "size": size, "film": self._film_state()}
            state |= {"mean_luminance": self._mean_luminance, "phases": dict(self._phases)}
            for name, strategy in self.mode.strategies.items():
                strategy.merge()
                state[name] = strategy.state_dict()
            optimizers = {name: each.state_dict() for name, each in self.mode.lens.optimizers.items()}
            by_pixel = {"lens": state["lens"], "optimizers": optimizers}
            state |= self.ranks.merged({"shadow_roulette": self.shadow_roulette.state_dict()}, self.pixels.mine)
            return state | self.ranks.merged(by_pixel, self.pixels.mine_in_frame())

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from the state of another loop, so that later steps have the same bits; collective.

        The scene and the settings must be equal. Only `spp`, `threads` and the number of ranks may differ.

        Raises BokehguideError, and changes nothing, for a state that does not fit or that is not of one moment.
        """
        place, own = "RenderLoop.load_state_dict", self.state_dict()
        self.require_state(place, state, own)
        require_one_moment(place, state)
        with all_or_nothing(place, (self.load_learned, own)):
            self.load_learned(state)
        self.load_film(state)

    def require_state(self, place: str, state: Mapping[str, Any], own: Mapping[str, Any]) -> None:
        """Raise BokehguideError for a state with other parts than `own`, the state of this loop. place: for errors."""
        require_loop_state(place, state, own, self.film.check_state)

    def load_learned(self, state: Mapping[str, Any]) -> None:
        """The part of `load_state_dict` for the strategies. Raises one of UNFIT if a part does not fit."""
        with self.workers.serial():
            self.shadow_roulette.load_state_dict(state["shadow_roulette"])
            for name, strategy in self.mode.strategies.items():
                strategy.load_state_dict(state[name])
            for name, optimizer in self.mode.lens.optimizers.items():
                optimizer.load_state_dict(deepcopy(state["optimizers"][name]))  # else it would share the tensors
            for strategy in self.mode.strategies.values():
                strategy.check(state["step"])

    def load_film(self, state: Mapping[str, Any]) -> None:
        """The part of `load_state_dict` for the film and the numbers of the loop."""
        with self.workers.serial():
            film = state["film"] if self.ranks.first else {**state["film"], "bad_count": 0, "bad_samples": []}
            self.film.load_state_dict(film)
        self.step_number, self._mean_luminance = state["step"], state["mean_luminance"]
        self._has_stepped = self.step_number > 0
        self._phases = Counter(state["phases"])

    def guide_images(self) -> dict[str, Tensor]:
        """Pictures of the learned state by name, `[H, W, 3]` in 0 … 1; empty without learning. Collective."""
        with self.workers.serial():
            self._learn()
        owned = self.pixels.mine_in_frame()
        beta = self.ranks.merged({"beta": self.mode.lens.blend_weights()}, owned)["beta"]
        return self.mode.lens.images(beta)


def _seconds(results: Sequence[BatchResult]) -> list[float]:
    """Seconds of each batch, from which `Batches` cuts the next step."""
    return [sum(result.timer.seconds.values()) for result in results]
