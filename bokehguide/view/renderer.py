"""The thread that renders the picture of the page."""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from bokehguide.errors import BokehguideError
from bokehguide.render import PathTracer
from bokehguide.runtime.distributed import available_cores
from bokehguide.runtime.process import return_freed_memory
from bokehguide.scene import Scene
from bokehguide.view.finisher import Finisher
from bokehguide.view.job import COARSE_PIXELS, PREVIEW_SPP, Job
from bokehguide.view.pictures import Shown, preview
from bokehguide.view.preview import QuickDenoiser, prepare
from bokehguide.view.state import Source, ViewState
from bokehguide.view.workers import AbandonedError, StoppableWorkers

log = logging.getLogger(__name__)

Answer = TypeVar("Answer")
LATEST = 0.25
"""Seconds after which a new picture is shown while steps go on."""
FIRST = 0.06
"""Seconds that the first picture after a change should take; its size follows from the last ones."""
TRIMMED = 32
"""Number of changes after which freed memory is returned: pictures of many sizes leave gaps of many sizes."""
LEAST_COARSE, MOST_COARSE = 3_000, 60_000
"""Bounds of the pixels of a first picture."""


class Wanted(NamedTuple):
    """The state to show, and the number of the change that led to it."""

    state: ViewState
    revision: int


@dataclass(frozen=True)
class Sight:
    """A published picture: its job, its number of steps, and the request."""

    job: Job
    step: int
    wanted: Wanted


class Listener:
    """Receives what a renderer has to tell, on threads of the renderer."""

    def shown(self, facts: dict[str, Any], shown: Shown) -> None:
        """A picture and the facts beside it."""

    def ended(self, job: Job, state: ViewState) -> None:
        """A render has all of its samples."""

    def failed(self, error: Exception) -> None:
        """A state cannot be rendered."""


class Renderer:
    """Renders the picture of a state, and starts anew at once when the state changes.

    The tracing structure, the tables of the lights and the list of the emitters stay. Samples and learned state stay while only
    the display changes. Another camera, lens, environment or mode starts without learned state, as the command line does, so that
    both give the same picture.

    halves: whether a denoiser is installed. threads: None for one for each core.
    """

    def __init__(self, source: Source, state: ViewState, listener: Listener, halves: bool, threads: int | None = None):
        self.source = source
        self._listener, self._halves = listener, halves
        self._changed = threading.Condition()
        self._wanted = Wanted(state, 0)
        self._watched = self._closed = self._rendering = False
        self._questions: deque[tuple[Callable[[Job], Any], Future[Any]]] = deque()
        self._workers = StoppableWorkers(threads or available_cores())
        self._tracer = PathTracer(source.scene)
        self._rotation = _rotation(source.scene)
        self._job: Job | None = None
        self._job_count = 0
        self._sight: Sight | None = None
        self._shown_at = 0.0
        self._failed: ViewState | None = None
        self._coarse_pixels = float(COARSE_PIXELS)
        self._denoiser = QuickDenoiser() if halves else None
        self._finisher = Finisher(self._publish_exact)
        self._thread = threading.Thread(target=self._run, name="renderer", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        prepare()
        self._thread.start()

    def close(self) -> None:
        """Abandon all work and end the threads."""
        with self._changed:
            self._closed = True
            self._workers.stop.set()
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()
        self._finisher.close()
        self._workers.close()

    @property
    def rendering(self) -> bool:
        """Whether a render runs."""
        return self._rendering

    def update(self, state: ViewState, revision: int) -> None:
        """Show another state. revision: number of the change, which the facts of its pictures repeat."""
        with self._changed:
            # The first picture of a job is never abandoned: otherwise a drag would show nothing until its end.
            if state.traced != self._wanted.state.traced and self._sight is not None and self._sight.job is self._job:
                self._workers.stop.set()
            self._wanted = Wanted(state, revision)
            self._changed.notify()

    def watch(self, watched: bool) -> None:
        """Render while somebody watches. Otherwise the picture is freed, unless a render runs."""
        with self._changed:
            self._watched = watched
            if not watched and not self._rendering:
                self._workers.stop.set()
            self._changed.notify()

    def render(self, rendering: bool) -> None:
        """Go on to the samples per pixel of the state, or pause."""
        with self._changed:
            self._rendering = rendering
            self._changed.notify()

    def ask(self, question: Callable[[Job], Answer]) -> Future[Answer]:
        """The answer of a function of the present job, which runs between two steps. The future is cancelled without a job."""
        future: Future[Answer] = Future()
        with self._changed:
            self._questions.append((question, future))
            self._changed.notify()
        return future

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._has_work)
                if self._closed:
                    break
                self._workers.stop.clear()
                wanted, active = self._wanted, self._watched or self._rendering
            try:
                self._work(wanted, active)
            except AbandonedError:
                self._job = None
            except (BokehguideError, RuntimeError, MemoryError) as error:
                log.warning("%s", error)
                self._rendering, self._job, self._failed = False, None, wanted.state
                self._listener.failed(error)
        self._forget()
        self._answer()

    def _has_work(self) -> bool:
        """Whether `_work` would do anything."""
        if self._closed or self._questions:
            return True
        if not (self._watched or self._rendering):
            return self._job is not None or self._sight is not None
        if self._failed == self._wanted.state:
            return False
        job = self._job
        return (
            self._rendering
            or job is None
            or job.traced != self._wanted.state.traced
            or not job.done(self._limit())
            or not self._is_shown(job)
        )

    def _limit(self) -> int:
        """Samples per pixel at which the steps end."""
        spp = self._wanted.state.spp
        return spp if self._rendering else min(spp, PREVIEW_SPP)

    def _is_shown(self, job: Job) -> bool:
        return self._sight == Sight(job, job.loop.step_number, self._wanted)

    def _work(self, wanted: Wanted, active: bool) -> None:
        """Answer questions, take one step, and show the picture."""
        if not active:
            self._forget()
        self._answer()
        state = wanted.state
        if not active or self._failed == state:
            return
        start, job = time.monotonic(), self._job
        if job is None or job.traced != state.traced:
            job = self._job = self._new_job(state)
        if not job.done(self._limit()):
            job.advance()
        first = self._sight is None or self._sight.job is not job
        outdated = self._wanted.state.traced != state.traced
        if self._is_due(job, wanted) and (first or not outdated):
            self._show(job, wanted)
            if first:
                self._coarse_pixels = coarse_pixels(self._coarse_pixels, time.monotonic() - start)
        if self._rendering and job.done(state.spp):
            self._rendering = False
            self._listener.ended(job, state)

    def _forget(self) -> None:
        """Free the picture."""
        self._finisher.stop()
        self._job = self._sight = None
        gc.collect()
        return_freed_memory()

    def _answer(self) -> None:
        while self._questions:
            question, future = self._questions.popleft()
            if self._job is None:
                future.cancel()
            elif future.set_running_or_notify_cancel():
                try:
                    future.set_result(question(self._job))
                except Exception as error:  # for the one who asked
                    future.set_exception(error)

    def _new_job(self, state: ViewState) -> Job:
        self._finisher.stop()
        self._job_count += 1
        if self._job_count % TRIMMED == 0:
            return_freed_memory()
        scene = self.source.scene_of(state.overrides)
        if _rotation(scene) != self._rotation:
            self._tracer = PathTracer(scene, geometry=self._tracer.geometry)
            self._rotation = _rotation(scene)
        return Job(scene, state, self._tracer, self._workers, self._halves, self._coarse_pixels)

    def _is_due(self, job: Job, wanted: Wanted) -> bool:
        """Whether to show the picture now: at once after a change, at each reduced size, at intervals, and at the end."""
        sight = self._sight
        changed = sight is None or sight.job is not job or sight.wanted != wanted
        return changed or not job.full_size or job.done(self._limit()) or time.monotonic() - self._shown_at > LATEST

    def _show(self, job: Job, wanted: Wanted) -> None:
        self._finisher.stop()
        job.measure()
        shown = preview(job.loop, wanted.state, self._denoiser)
        self._listener.shown(self._facts(job, wanted, shown), shown)
        self._sight = Sight(job, job.loop.step_number, wanted)
        self._shown_at = time.monotonic()
        if job.done(self._limit()) and wanted.state.layer == "picture":
            self._finisher.start(job, wanted.state, wanted.revision)

    def _publish_exact(self, job: Job, state: ViewState, revision: int, shown: Shown) -> None:
        """Publish the exact picture of a job that rests, on the thread of the finisher."""
        with self._changed:
            wanted = Wanted(state, revision)
            if self._sight != Sight(job, job.loop.step_number, wanted) or self._wanted != wanted:
                return
        self._listener.shown({**self._facts(job, wanted, shown), "exact": True}, shown)

    def _facts(self, job: Job, wanted: Wanted, shown: Shown) -> dict[str, Any]:
        """The facts beside a picture, as JSON values."""
        limit, stats = self._limit(), job.stats
        seconds = max(stats.seconds, 1e-9) if stats else 1.0
        return {
            "revision": wanted.revision,
            "width": job.scene.film.width,
            "height": job.scene.film.height,
            "reduction": job.reduction,
            "spp": job.loop.step_number if job.full_size else 0,
            "limit": limit,
            "rendering": self._rendering,
            "done": job.done(limit),
            "exact": False,
            "seconds": job.seconds,
            "rays_per_second": stats.rays / seconds if stats else 0.0,
            "samples_per_second": stats.samples / seconds if stats else 0.0,
            "error": job.curve[-1][1] if job.curve else None,
            "curve": job.curve[-512:],
            "exposure": shown.exposure,
        }


def coarse_pixels(pixels: float, seconds: float) -> float:
    """Pixels of the next first picture after a change, where one of `pixels` took `seconds`."""
    return min(max(pixels * min(max(FIRST / max(seconds, 1e-3), 0.5), 1.5), LEAST_COARSE), MOST_COARSE)


def _rotation(scene: Scene) -> float:
    """Rotation of the environment, 0 without one."""
    return 0.0 if scene.environment is None else scene.environment.rotation
