"""Paths one after the other, in the scalar variants of Mitsuba. A loop in Python: for checks, not for speed."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from bokehguide.mitsuba.emitters import EmitterScene, luminance
from bokehguide.mitsuba.frame import Frame
from bokehguide.mitsuba.lens import LensSamples, SeenLight
from bokehguide.mitsuba.paths import Paths


class OneByOne(Paths):
    """One path after the other."""

    def __init__(self, nested: Any, scene: Any, sensor: Any, frame: Frame, emitters: EmitterScene):
        super().__init__(nested, scene, sensor, frame, emitters)
        numbered = zip(scene.shapes(), emitters.first_triangles, emitters.per_triangle)
        self._shapes = [(shape, int(first), bool(each)) for shape, first, each in numbered if first >= 0]
        self._box = self._film.rfilter().is_box_filter()

    def trace(self, drawn: LensSamples, seed: int, spp: int, block: Any | None) -> SeenLight | None:
        count = len(drawn.weight)
        light, place, number = np.zeros(count, np.float32), np.full((3, count), np.inf), np.full(count, -1)
        self._sampler.seed(seed)
        for index in range(count):
            x, y = (float(each) - self._frame.border for each in drawn.raster[:, index])
            if drawn.weight[index] > 0.0:
                # The x axis of the sensor points to the left.
                disc = mi.Point2f(-float(drawn.points[0, index]), float(drawn.points[1, index]))
                aperture = mi.warp.uniform_disk_to_square_concentric(disc)
                ray, light[index] = self._path((x, y), aperture, float(drawn.weight[index]), spp, block)
                if drawn.learned:
                    place[:, index], number[index] = self._surface(ray)
            else:
                self._splat(block, (x, y), mi.Color3f(0.0), 0.0, [0.0] * len(self._nested.aov_names()))
        return SeenLight(light, self._distances(drawn, place, np.isfinite(place).all(axis=0)), number) if drawn.learned else None

    def trace_uniform(self, pixels: np.ndarray, count: int, seed: int, spp: int, block: Any) -> None:
        self._sampler.seed(seed)
        for pixel in np.repeat(pixels, count).tolist():
            row, column = divmod(pixel, self._frame.width)
            across, down = self._sampler.next_2d()
            at = column + float(across) - self._frame.border, row + float(down) - self._frame.border
            self._path(at, mi.Point2f(self._sampler.next_2d()), 1.0, spp, block)

    def _path(self, at: tuple[float, float], aperture: Any, weight: float, spp: int, block: Any | None) -> tuple[Any, float]:
        """Trace one path from a position on the film and put it on the block. Returns the camera ray, and the luminance."""
        (left, top), (across, down), sensor = self._frame.corner, self._frame.size, self._sensor
        time = sensor.shutter_open() + self._sampler.next_1d() * sensor.shutter_open_time()
        wavelength = self._sampler.next_1d() if mi.is_spectral else 0.0
        film = mi.Point2f((at[0] - left) / across, (at[1] - top) / down)
        ray, ray_weight = sensor.sample_ray_differential(time, wavelength, film, aperture)
        ray.scale_differential(spp**-0.5)
        value, valid, aovs = self._nested.sample(self._scene, self._sampler, ray, sensor.get_medium(), True)
        value = mi.unpolarized_spectrum(value) * ray_weight
        if not np.isfinite(np.array(value)).all():
            value = type(value)(0.0)
        color = mi.spectrum_to_srgb(value, ray.wavelengths) if mi.is_spectral else value
        color = mi.Color3f(color[0]) if mi.is_monochromatic else color
        self._splat(block, at, color * weight, weight * bool(valid), [float(each) * weight for each in aovs])
        return ray, float(luminance(value, ray.wavelengths))

    def _surface(self, ray: Any) -> tuple[Any, int]:
        """The place of the first surface, infinite without one, and the number of its triangle."""
        surface = self._scene.ray_intersect_preliminary(ray)
        return (np.array(ray(surface.t)), self._number(surface)) if surface.is_valid() else (np.inf, -1)

    def _number(self, surface: Any) -> int:
        """The number of an emitting triangle in the scene of emitters, -1 for other surfaces."""
        for shape, first, each in self._shapes:
            if surface.shape == shape:
                return first + each * surface.prim_index
        return -1

    def _splat(self, block: Any | None, at: tuple[float, float], color: Any, alpha: float, channels: list[float]) -> None:
        """Put one sample on the block, if there is one."""
        if block is None:
            return
        position = mi.Vector2f(np.floor(at[0]), np.floor(at[1])) if self._box else mi.Vector2f(*at)
        opaque = [alpha] if mi.has_flag(self._film.flags(), mi.FilmFlags.Alpha) else []
        block.put(position, [float(color[0]), float(color[1]), float(color[2]), *opaque, 1.0, *channels])
