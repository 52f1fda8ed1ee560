"""Pictures of a view that another program moves, such as the viewport of a 3D editor."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.image.oidn import has_denoiser
from bokehguide.render import PathTracer
from bokehguide.runtime.distributed import available_cores
from bokehguide.scene import Camera, Scene, load_scene
from bokehguide.scene.overrides import NO_OVERRIDES
from bokehguide.view.job import COARSE_PIXELS, Job, Window
from bokehguide.view.jobs import coarse_pixels
from bokehguide.view.preview import QuickDenoiser, prepare
from bokehguide.view.renderer import LATEST
from bokehguide.view.state import ViewState
from bokehguide.view.workers import AbandonedError, StoppableWorkers

log = logging.getLogger(__name__)

SHARE = 4.0
"""A picture is published after this many times the time that the publication of the last one took."""


@dataclass(frozen=True)
class LiveView:
    """A view of a scene file.

    scene: path of the file, whose camera and film size the view replaces; a file is read once and must not change. size: width
    and height of the frame in pixels. window: the part of the frame that is rendered. spp: samples per pixel at which the
    picture rests. denoise: whether pictures are denoised quickly, if a denoiser is installed.
    """

    scene: str
    camera: Camera
    size: tuple[int, int]
    window: Window
    spp: int
    seed: int = 0
    denoise: bool = False


@dataclass(frozen=True)
class LivePicture:
    """pixels: linear radiance, premultiplied, and alpha, float32 `[H, W, 4]`, top row first; the size may be a reduced one.

    step: samples per pixel so far, 0 at a reduced size.
    """

    view: LiveView
    pixels: np.ndarray
    step: int


class Live:
    """Renders the latest view, first at a reduced size, and starts anew when another view is shown.

    publish: receives each picture. fail: receives a view that cannot be rendered, and why. Both are called on the thread of
    `run`. threads: None for one for each core.
    """

    def __init__(self, publish: Callable[[LivePicture], None], fail: Callable[[LiveView, str], None], threads: int | None = None):
        self._publish, self._fail = publish, fail
        self._changed = threading.Condition()
        self._wanted: LiveView | None = None
        self._ended: LiveView | None = None
        """The view that has all samples, or has failed."""
        self._closed = self._shown = False
        self._workers = StoppableWorkers(threads or available_cores())
        self._denoiser = QuickDenoiser() if has_denoiser() else None
        self._scene: Scene | None = None
        self._tracer: PathTracer | None = None
        self._path = ""
        self._view: LiveView | None = None
        self._job: Job | None = None
        self._pixels, self._due = float(COARSE_PIXELS), 0.0

    def show(self, view: LiveView) -> None:
        """Render this view from now on. Returns at once; any thread may call."""
        with self._changed:
            if view != self._wanted:
                self._wanted = view
                if self._shown:  # the first picture is never abandoned: a drag would show nothing until its end
                    self._workers.stop.set()
                self._changed.notify()

    def close(self) -> None:
        """End `run` soon. Any thread may call."""
        with self._changed:
            self._closed = True
            self._workers.stop.set()
            self._changed.notify()

    def run(self) -> None:
        """Render until `close`."""
        prepare()
        while (view := self._next()) is not None:
            try:
                self._work(view)
            except AbandonedError:
                self._view = None
            except (BokehguideError, RuntimeError, MemoryError) as error:
                log.debug("%s", error, exc_info=True)
                self._view, self._ended = None, view
                self._fail(view, str(error) or "the memory does not suffice; make the viewport smaller")
        self._workers.close()

    def _next(self) -> LiveView | None:
        """The view to work on; None after `close`. Waits until there is work."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._wanted != self._ended)
            self._workers.stop.clear()
            return None if self._closed else self._wanted

    def _work(self, view: LiveView) -> None:
        """Take one step, and publish its picture if one is due."""
        if view.scene != self._path:
            self._load(view.scene)
        start = time.monotonic()
        if self._job is None or view != self._view:
            self._shown, self._view, self._job = False, view, self._new_job(view)
        job = self._job
        job.advance()
        done, first = job.done(view.spp), not self._shown
        if first or done or not job.full_size or time.monotonic() > self._due:
            self._show(job, view)
        if first:
            self._pixels = coarse_pixels(self._pixels, time.monotonic() - start)
            self._shown = True
        if done:
            self._ended = view

    def _load(self, path: str) -> None:
        """Read a scene file. Raises BokehguideError."""
        self._view, self._job, self._scene, self._tracer, self._path = None, None, None, None, ""
        self._scene = load_scene(path, NO_OVERRIDES, allow_outside=True)
        self._tracer, self._path = PathTracer(self._scene), path

    def _new_job(self, view: LiveView) -> Job:
        assert self._scene is not None and self._tracer is not None
        width, height = view.size
        film = replace(self._scene.film, width=width, height=height)
        scene = replace(self._scene, camera=view.camera, film=film)
        state = ViewState(NO_OVERRIDES, seed=view.seed, denoise=view.denoise and self._denoiser is not None)
        window = None if view.window == (0, 0, width, height) else view.window
        return Job(scene, state, self._tracer, self._workers, pixels=self._pixels, window=window)

    def _show(self, job: Job, view: LiveView) -> None:
        start = time.monotonic()
        layers = job.loop.film.layers()
        radiance = layers["beauty"]
        if view.denoise and self._denoiser is not None:
            radiance = self._denoiser(radiance)
        pixels = np.concatenate((radiance, layers["alpha"][..., None]), axis=-1, dtype=np.float32)
        self._publish(LivePicture(view, pixels, job.loop.step_number if job.full_size else 0))
        now = time.monotonic()
        self._due = now + max(LATEST, SHARE * (now - start))
