"""The thread that renders the picture of the page."""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from bokehguide.errors import BokehguideError
from bokehguide.runtime.distributed import available_cores
from bokehguide.runtime.process import return_freed_memory
from bokehguide.view.facts import picture_facts
from bokehguide.view.finisher import Finisher
from bokehguide.view.hand import Hand
from bokehguide.view.job import PREVIEW_SPP, Job
from bokehguide.view.jobs import Jobs
from bokehguide.view.kept import Kept
from bokehguide.view.pictures import Shown, preview
from bokehguide.view.preview import QuickDenoiser, prepare
from bokehguide.view.questions import Questions
from bokehguide.view.sights import Listener, Sight, Wanted
from bokehguide.view.state import Source, ViewState
from bokehguide.view.workers import AbandonedError, StoppableWorkers

log = logging.getLogger(__name__)

Answer = TypeVar("Answer")
LATEST = 0.25
"""Seconds after which a new picture is shown while steps go on."""


class Renderer:
    """Renders the picture of a state, and starts anew at once when the state changes.

    The tracing structure, the tables of the lights and the list of the emitters stay. A change of the display keeps all samples.
    Learned state stays where another camera or lens can begin with it (see `Kept`). When such a picture rests, an exact job takes
    its place: it begins without learned state, as the command line does, and gives the same picture as the command line.

    denoiser: whether a denoiser is installed. threads: None for one for each core.
    """

    def __init__(self, source: Source, state: ViewState, listener: Listener, denoiser: bool, threads: int | None = None):
        self.source = source
        self._listener = listener
        self._changed = threading.Condition()
        self._wanted = Wanted(state, 0)
        self._watched = self._closed = self._rendering = self._paused = False
        self._workers = StoppableWorkers(threads or available_cores())
        """The workers of the present job."""
        self._hand = Hand()
        """Builds and advances jobs. A change does not wait for the end of its work."""
        self._questions = Questions()
        self._exact: Job | None = None
        """The exact job that takes the place of the present one when it has as many samples."""
        self._jobs = Jobs(source, self._hand)
        self._job: Job | None = None
        self._sight: Sight | None = None
        self._shown_at = 0.0
        self._failed: ViewState | None = None
        self._denoiser = QuickDenoiser() if denoiser else None
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
        self._hand.close()
        self._workers.close()

    @property
    def rendering(self) -> bool:
        """Whether a render runs."""
        return self._rendering

    @property
    def paused(self) -> bool:
        """Whether a render was stopped, and can go on from its samples."""
        job = self._job
        return self._paused and not (job is not None and job.exact and job.done(self._wanted.state.spp))

    @property
    def exact(self) -> bool:
        """Whether the samples of the picture are those of the command line."""
        job = self._job
        return job is not None and job.exact

    def update(self, state: ViewState, revision: int) -> None:
        """Show another state. revision: number of the change, which the facts of its pictures repeat."""
        with self._changed:
            # The first picture of a job is never abandoned: otherwise a drag would show nothing until its end.
            if state.traced != self._wanted.state.traced and self._sight is not None and self._sight.job is self._job:
                self._workers.stop.set()
            self._paused = self._paused and self._job is not None and self._job.serves(state)
            self._wanted = Wanted(state, revision)
            self._changed.notify()

    def watch(self, watched: bool) -> bool:
        """Render while somebody watches. Otherwise free the picture; a render rests after its step, and keeps its samples.

        Returns whether a paused render goes on.
        """
        with self._changed:
            resumes = watched and not self._watched and self._rendering
            self._watched = watched
            if not watched and not self._begun:
                self._workers.stop.set()
            self._changed.notify()
        return resumes

    def render(self, rendering: bool) -> None:
        """Go on to the samples per pixel of the state, or pause."""
        with self._changed:
            self._paused = not rendering and self._begun
            self._rendering = rendering
            self._changed.notify()

    def ask(self, question: Callable[[Job], Answer], exact: bool = False) -> Future[Answer]:
        """The answer of a function of the present job, which runs between two steps. The future is cancelled without a job.

        exact: whether to wait for the exact job with as many samples. After another change, the future has a BokehguideError.
        """
        with self._changed:
            future = self._questions.ask(question, exact)
            self._changed.notify()
        return future

    def _run(self) -> None:
        with self._workers.serial():  # the operations of a small picture are too short for a second thread
            self._work_on()

    def _work_on(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._has_work)
                if self._closed:
                    break
                wanted, active = self._wanted, self._watched
            try:
                self._work(wanted, active)
            except AbandonedError:
                self._drop()
            except (BokehguideError, RuntimeError, MemoryError) as error:
                log.warning("%s", error)
                self._rendering, self._paused, self._failed = False, False, wanted.state
                self._drop()
                self._listener.failed(error)
        self._forget()
        self._questions.answer(self._job)

    def _has_work(self) -> bool:
        """Whether `_work` would do anything."""
        if self._closed or self._questions.of_any:
            return True
        if not self._watched:
            return not self._begun and (self._job is not None or self._sight is not None)
        if self._failed == self._wanted.state:
            return False
        job = self._job
        return (
            self._rendering
            or bool(self._questions.of_exact)
            or job is None
            or not job.serves(self._wanted.state)
            or not (job.exact and job.done(self._limit()))
            or not self._is_shown(job)
        )

    @property
    def _begun(self) -> bool:
        """Whether a render has samples that must stay."""
        return self._rendering or self._paused

    def _limit(self) -> int:
        """Samples per pixel at which the steps end."""
        spp, job = self._wanted.state.spp, self._job
        if self._paused and job is not None and job.exact and job.full_size:
            return job.loop.step_number
        return spp if self._rendering else min(spp, PREVIEW_SPP)

    def _sight_of(self, job: Job, wanted: Wanted) -> Sight:
        return Sight(job, job.loop.camera.width, job.loop.step_number, wanted, job.done(self._limit()))

    def _is_shown(self, job: Job) -> bool:
        return self._sight == self._sight_of(job, self._wanted)

    def _work(self, wanted: Wanted, active: bool) -> None:
        """Answer questions, take one step, and show the picture."""
        if not (active or self._begun):
            self._forget()
        self._questions.answer(self._job)
        state = wanted.state
        if not active or self._failed == state:
            return
        start, job = time.monotonic(), self._job
        if job is None or not job.serves(state):
            job = self._job = self._new_job(state)
        at_first = job.at_first
        job = self._job = self._advance(job, state)
        first = self._sight is None or self._sight.job is not job
        outdated = self._wanted.state.traced != state.traced
        if self._is_due(job, wanted) and (first or not outdated):
            self._show(job, wanted)
            if at_first:
                self._jobs.adapt(time.monotonic() - start)
        if self._rendering and job.done(state.spp):
            self._rendering = False
            self._listener.ended(job, state)

    def _advance(self, job: Job, state: ViewState) -> Job:
        """Take a step of the job, or of the exact job that takes its place; returns the job to show."""
        if job.at_first:
            job.advance()
        elif job.exact or not (self._rendering or self._questions.of_exact or job.done(self._limit())):
            if not job.done(self._limit()):
                self._hand.do(job.advance, self._workers.stop)
        else:
            if self._exact is None:
                self._exact = self._jobs.exact(state, self._workers)
            self._hand.do(self._exact.advance, self._workers.stop)
            if self._rendering or self._exact.done(job.loop.step_number):
                job, self._exact = self._exact, None
        return job

    def _drop(self) -> None:
        """Drop the job, and keep what it has learned."""
        job, self._job, self._exact = self._job, None, None
        if job is not None and job.full_size:
            self._jobs.kept.take(job.loop)
        self._questions.refuse()

    def _forget(self) -> None:
        """Free the picture."""
        self._finisher.stop()
        self._drop()
        self._sight, self._jobs.kept = None, Kept()
        self._hand.rest()
        gc.collect()
        return_freed_memory()

    def _new_job(self, state: ViewState) -> Job:
        self._finisher.stop()
        self._drop()
        with self._changed:
            self._workers = self._workers.renewed()
        return self._jobs.next(state, self._workers)

    def _is_due(self, job: Job, wanted: Wanted) -> bool:
        """Whether to show the picture now: at once after a change, at each reduced size, at intervals, and at the end."""
        sight = self._sight
        if self._is_shown(job):
            return False
        changed = sight is None or sight.job is not job or sight.wanted != wanted
        return changed or not job.full_size or job.done(self._limit()) or time.monotonic() - self._shown_at > LATEST

    def _show(self, job: Job, wanted: Wanted) -> None:
        self._finisher.stop()
        job.measure()
        shown = preview(job.loop, wanted.state, self._denoiser)
        self._listener.shown(self._facts(job, wanted, shown), shown)
        self._sight = self._sight_of(job, wanted)
        self._shown_at = time.monotonic()
        if job.exact and job.done(self._limit()) and wanted.state.layer == "picture":
            self._finisher.start(job, wanted.state, wanted.revision)

    def _publish_exact(self, job: Job, state: ViewState, revision: int, shown: Shown) -> None:
        """Publish the exact picture of a job that rests, on the thread of the finisher."""
        with self._changed:
            wanted = Wanted(state, revision)
            if self._sight != self._sight_of(job, wanted) or self._wanted != wanted:
                return
        self._listener.shown({**self._facts(job, wanted, shown), "exact": True}, shown)

    def _facts(self, job: Job, wanted: Wanted, shown: Shown) -> dict[str, Any]:
        limit = wanted.state.spp if self._begun else self._limit()
        return picture_facts(job, limit, self._rendering, wanted.revision, shown.exposure)
