"""A render with Mitsuba, step by step: one sample per pixel through drawn lens points, then a report to the lens."""

from __future__ import annotations

from typing import Any, Self

import mitsuba as mi
import numpy as np

from bokehguide.mitsuba.emitters import read_emitters
from bokehguide.mitsuba.frame import read_frame
from bokehguide.mitsuba.lens import GuidedLens
from bokehguide.mitsuba.one_by_one import OneByOne
from bokehguide.mitsuba.variants import is_scalar
from bokehguide.mitsuba.wavefront import Wavefront
from bokehguide.render.random import hash_int


class Rendering:
    """A render of a scene with a nested integrator. The object is a context manager. Raises BokehguideError as `read_frame`."""

    def __init__(self, nested: Any, mode: str, scene: Any, sensor: Any, seed: int):
        self._names, self._sensor, self._film, self._seed = nested.aov_names(), sensor, sensor.film(), seed
        self._frame = frame = read_frame(sensor)
        emitters = read_emitters(scene, frame.camera, frame.width, frame.height, np.linalg.inv(frame.to_world))
        self._paths = (OneByOne if is_scalar() else Wavefront)(nested, scene, sensor, frame, emitters)
        self._lens = GuidedLens(emitters.scene, frame.pixels, mode, seed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._lens.close()

    def picture(self, spp: int, develop: bool) -> Any:
        """The film after `spp` samples per pixel, 0 for those of the sensor; an empty tensor without `develop`."""
        self._film.prepare(self._names)
        spp, step = spp or self._sensor.sampler().sample_count(), 0
        while step < spp:
            drawn, block = self._lens.draw(spp - step), self._film.create_block()
            seen = self._paths.trace(drawn, hash_int(self._seed ^ hash_int(step)), spp, block)
            if seen is not None:
                self._lens.learn(seen)
            self._film.put_block(block)
            step += len(drawn.weight) // len(self._frame.pixels)
        return self._film.develop() if develop else mi.TensorXf()
