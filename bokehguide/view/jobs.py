"""The jobs of a scene, with all that stays from one to the next."""

from __future__ import annotations

from bokehguide.render import PathTracer
from bokehguide.render.random import hash_int
from bokehguide.runtime.process import return_freed_memory
from bokehguide.scene import Scene
from bokehguide.view.hand import Hand
from bokehguide.view.job import COARSE_PIXELS, Job, reduced_sizes
from bokehguide.view.kept import Kept
from bokehguide.view.state import Source, ViewState
from bokehguide.view.workers import StoppableWorkers

FIRST = 0.045
"""Seconds that the first picture after a change should take; its size follows from the last ones."""
TRIMMED = 32
"""Number of changes after which freed memory is returned: pictures of many sizes leave gaps of many sizes."""
LEAST_COARSE, MOST_COARSE = 3_000, 60_000
"""Bounds of the pixels of a first picture."""


class Jobs:
    """Makes jobs. The tracing structure, the tables of the lights and learned state stay.

    hand: runs the steps of the jobs at full size.
    """

    def __init__(self, source: Source, hand: Hand):
        self._source, self._hand = source, hand
        self._tracer = PathTracer(source.scene)
        self._rotation = _rotation(source.scene)
        self._count = 0
        self._coarse_pixels = float(COARSE_PIXELS)
        self.kept = Kept()

    def next(self, state: ViewState, workers: StoppableWorkers) -> Job:
        """A job of a state, which begins with what earlier jobs have learned. Raises AbandonedError."""
        self._count += 1
        if self._count % TRIMMED == 0:
            return_freed_memory()
        scene = self._source.scene_of(state.overrides)
        if _rotation(scene) != self._rotation:
            self._tracer = PathTracer(scene, geometry=self._tracer.geometry)
            self._rotation = _rotation(scene)
        seed = hash_int(hash_int(state.seed) + self._count)

        def make() -> Job:
            return Job(scene, state, self._tracer, workers, self._coarse_pixels, kept=self.kept, seed=seed)

        if len(reduced_sizes(scene.film, self._coarse_pixels)) > 1:
            return make()
        return self._hand.do(make, workers.stop)  # only the hand may read what is kept

    def exact(self, state: ViewState, workers: StoppableWorkers) -> Job:
        """A job of the same state at full size, without kept state. Raises AbandonedError."""
        scene = self._source.scene_of(state.overrides)
        pixels = scene.film.width * scene.film.height
        return self._hand.do(lambda: Job(scene, state, self._tracer, workers, pixels), workers.stop)

    def adapt(self, seconds: float) -> None:
        """Set the size of the next first picture by the time that the last one took."""
        self._coarse_pixels = coarse_pixels(self._coarse_pixels, seconds)


def coarse_pixels(pixels: float, seconds: float) -> float:
    """Pixels of the next first picture after a change, where one of `pixels` took `seconds`."""
    return min(max(pixels * min(max(FIRST / max(seconds, 1e-3), 0.5), 1.5), LEAST_COARSE), MOST_COARSE)


def _rotation(scene: Scene) -> float:
    """Rotation of the environment, 0 without one."""
    return 0.0 if scene.environment is None else scene.environment.rotation
