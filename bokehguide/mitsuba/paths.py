"""The interface to the paths of a nested integrator."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bokehguide.mitsuba.emitters import EmitterScene
from bokehguide.mitsuba.frame import Frame
from bokehguide.mitsuba.lens import LensSamples, SeenLight


class Paths(ABC):
    """Traces the paths of a nested integrator through given lens points."""

    def __init__(self, nested: Any, scene: Any, sensor: Any, frame: Frame, emitters: EmitterScene):
        self._nested, self._scene, self._sensor, self._film, self._frame = nested, scene, sensor, sensor.film(), frame
        self._to_sensor = np.linalg.inv(frame.to_world)
        self._sampler = sensor.sampler().clone()

    @abstractmethod
    def trace(self, drawn: LensSamples, seed: int, spp: int, block: Any | None) -> SeenLight | None:
        """Trace one path for each sample and put it on the block, if there is one. Returns the report, None if the lens does not
        learn."""

    @abstractmethod
    def trace_uniform(self, pixels: np.ndarray, count: int, seed: int, spp: int, block: Any) -> None:
        """Trace `count` paths for each pixel of the frame through uniform lens points, and put them on the block."""

    def _distances(self, drawn: LensSamples, places: np.ndarray, hit: ArrayLike) -> np.ndarray:
        """Distances float32 `[N]` from the lens points to surfaces, infinite without a hit.

        places: world space, `[3, N]`. hit: whether a ray meets a surface, bool `[N]`.
        """
        local = self._to_sensor[:3, :3] @ np.where(hit, places, 0.0) + self._to_sensor[:3, 3:]
        points = self._frame.camera.aperture_radius * drawn.points.astype(np.float64)
        away = local - np.stack((-points[0], points[1], np.zeros(points.shape[1])))
        return np.where(hit, np.linalg.norm(away, axis=0), np.inf).astype(np.float32)
