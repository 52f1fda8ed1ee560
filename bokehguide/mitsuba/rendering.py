"""A render with Mitsuba: a pilot, then samples through drawn lens points, and reports to the lens, step by step."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from bokehguide.mitsuba.emitters import read_emitters
from bokehguide.mitsuba.frame import read_frame
from bokehguide.mitsuba.lens import GuidedLens
from bokehguide.mitsuba.one_by_one import OneByOne
from bokehguide.mitsuba.paths import Paths
from bokehguide.mitsuba.pilot import expected_gain
from bokehguide.mitsuba.variants import is_scalar
from bokehguide.mitsuba.wavefront import Wavefront
from bokehguide.render.random import hash_int

LEAST_GAIN = 1.1
"""Ratio of the errors in a pilot from which the lens is guided."""
SURVEY = 4
"""Steps of all pixels, after which pixels that see no known emitter or highlight get uniform lens points."""
PATHS_PER_PASS = 1 << 24
"""Paths through uniform lens points that are traced at once; their random numbers take 16 bytes each."""


class Rendering:
    """A render of a scene with a nested integrator. Raises BokehguideError as `read_frame`."""

    def __init__(self, nested: Any, mode: str, scene: Any, sensor: Any, seed: int):
        self._nested, self._mode, self._scene, self._sensor, self._seed = nested, mode, scene, sensor, seed
        self._film, self._frame = sensor.film(), read_frame(sensor)
        to_sensor = np.linalg.inv(self._frame.to_world)
        self._emitters = read_emitters(scene, self._frame.camera, self._frame.width, self._frame.height, to_sensor)
        arguments = nested, scene, sensor, self._frame, self._emitters
        self._paths: Paths = OneByOne(*arguments) if is_scalar() else Wavefront(*arguments)

    def picture(self, spp: int, develop: bool) -> Any:
        """The film after `spp` samples per pixel, 0 for those of the sensor; an empty tensor without `develop`."""
        spp = spp or self._sensor.sampler().sample_count()
        if self._gains(spp):
            self._film.prepare(self._nested.aov_names())
            with GuidedLens(self._emitters.scene, self._frame.pixels, self._mode, self._seed) as lens:
                self._trace(lens, spp)
        else:
            self._nested.render(self._scene, self._sensor, self._seed, spp, develop=False, evaluate=False)
        return self._film.develop() if develop else mi.TensorXf()

    def _gains(self, spp: int) -> bool:
        """Whether the lens is guided: in all modes but `guided`, which asks a pilot."""
        if self._mode != "guided":
            return True
        return expected_gain(self._paths, self._emitters.scene, self._frame, self._seed, spp) >= LEAST_GAIN

    def _trace(self, lens: GuidedLens, spp: int) -> None:
        """Trace all samples, and put them on the film."""
        step, pixels = 0, self._frame.pixels
        while step < spp and len(pixels):
            drawn, block = lens.draw(spp - step), self._film.create_block()
            seen = self._paths.trace(drawn, self._step_seed(step), spp, block)
            if seen is not None:
                lens.learn(seen)
            step += len(drawn.weight) // len(pixels)
            if step == SURVEY < spp and self._mode == "guided":
                guided = lens.guided()
                if not guided.all():
                    self._trace_uniform(pixels[~guided], spp - step, spp, block)
                    pixels = pixels[guided]
                    lens.restrict(pixels)
            self._film.put_block(block)

    def _trace_uniform(self, pixels: np.ndarray, count: int, spp: int, block: Any) -> None:
        """Trace `count` of `spp` samples of the pixels through uniform lens points, in passes of bounded memory."""
        each = max(PATHS_PER_PASS // len(pixels), 1)
        for number, first in enumerate(range(0, count, each)):
            self._paths.trace_uniform(pixels, min(each, count - first), self._step_seed(spp + number), spp, block)

    def _step_seed(self, step: int) -> int:
        return hash_int(self._seed ^ hash_int(step))
