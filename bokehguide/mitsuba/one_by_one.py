"""Paths one after the other, in the scalar variants of Mitsuba. A loop in Python: for checks, not for speed."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from bokehguide.mitsuba.emitters import EmitterScene, luminance
from bokehguide.mitsuba.frame import Frame
from bokehguide.mitsuba.lens import LensSamples, SeenLight


class OneByOne:
    """Traces the paths of a nested integrator through given lens points."""

    def __init__(self, nested: Any, scene: Any, sensor: Any, frame: Frame, emitters: EmitterScene):
        self._nested, self._scene, self._sensor, self._film, self._frame = nested, scene, sensor, sensor.film(), frame
        self._to_sensor = np.linalg.inv(frame.to_world)
        self._sampler = sensor.sampler().clone()
        self._shapes = [(shape, int(first), bool(each)) for shape, first, each in _numbered(scene, emitters) if first >= 0]
        self._box = self._film.rfilter().is_box_filter()

    def trace(self, drawn: LensSamples, seed: int, spp: int, block: Any) -> SeenLight | None:
        """Trace one path for each sample and put it on the block. Returns the report, None if the lens does not learn."""
        count = len(drawn.weight)
        light, place, number = np.zeros(count, np.float32), np.full((3, count), np.inf), np.full(count, -1)
        self._sampler.seed(seed)
        for index in range(count):
            x, y = (float(each) - self._frame.border for each in drawn.raster[:, index])
            position = mi.Vector2f(np.floor(x), np.floor(y)) if self._box else mi.Vector2f(x, y)
            if drawn.weight[index] > 0.0:
                light[index], hit, number[index] = self._path(drawn, index, (x, y), position, spp, block)
                place[:, index] = np.inf if hit is None else hit
            else:
                self._splat(block, position, mi.Color3f(0.0), 0.0, [0.0] * len(self._nested.aov_names()))
        return SeenLight(light, self._distances(drawn, place), number) if drawn.learned else None

    def _path(
        self, drawn: LensSamples, index: int, at: tuple[float, float], position: Any, spp: int, block: Any
    ) -> tuple[float, Any, int]:
        """Trace one path; returns its luminance, its first surface or None, and the number of the triangle there."""
        (left, top), (across, down), sensor = self._frame.corner, self._frame.size, self._sensor
        disc = mi.Point2f(-float(drawn.points[0, index]), float(drawn.points[1, index]))
        time = sensor.shutter_open() + self._sampler.next_1d() * sensor.shutter_open_time()
        wavelength = self._sampler.next_1d() if mi.is_spectral else 0.0
        film = mi.Point2f((at[0] - left) / across, (at[1] - top) / down)
        aperture = mi.warp.uniform_disk_to_square_concentric(disc)
        ray, ray_weight = sensor.sample_ray_differential(time, wavelength, film, aperture)
        ray.scale_differential(spp**-0.5)
        value, valid, aovs = self._nested.sample(self._scene, self._sampler, ray, sensor.get_medium(), True)
        value = mi.unpolarized_spectrum(value) * ray_weight
        if not np.isfinite(np.array(value)).all():
            value = type(value)(0.0)
        weight, shown = float(drawn.weight[index]), luminance(value, ray.wavelengths)
        color = mi.spectrum_to_srgb(value, ray.wavelengths) if mi.is_spectral else value
        color = mi.Color3f(color[0]) if mi.is_monochromatic else color
        self._splat(block, position, color * weight, weight * bool(valid), [float(each) * weight for each in aovs])
        if not drawn.learned:
            return float(shown), None, -1
        surface = self._scene.ray_intersect_preliminary(ray)
        if not surface.is_valid():
            return float(shown), None, -1
        return float(shown), np.array(ray(surface.t)), self._number(surface)

    def _number(self, surface: Any) -> int:
        """The number of an emitting triangle in the scene of emitters, -1 for other surfaces."""
        for shape, first, each in self._shapes:
            if surface.shape == shape:
                return first + each * surface.prim_index
        return -1

    def _splat(self, block: Any, position: Any, color: Any, alpha: float, channels: list[float]) -> None:
        """Put one sample on a block."""
        opaque = [alpha] if mi.has_flag(self._film.flags(), mi.FilmFlags.Alpha) else []
        block.put(position, [float(color[0]), float(color[1]), float(color[2]), *opaque, 1.0, *channels])

    def _distances(self, drawn: LensSamples, place: np.ndarray) -> np.ndarray:
        """Distances `[N]` from the lens points to the surfaces at `place` `[3, N]`, world space."""
        hit = np.isfinite(place).all(axis=0)
        local = self._to_sensor[:3, :3] @ np.where(hit, place, 0.0) + self._to_sensor[:3, 3:]
        points = self._frame.camera.aperture_radius * drawn.points.astype(np.float64)
        away = local - np.stack((-points[0], points[1], np.zeros(points.shape[1])))
        return np.where(hit, np.linalg.norm(away, axis=0), np.inf).astype(np.float32)


def _numbered(scene: Any, emitters: EmitterScene) -> Any:
    """The shapes of a scene with their first triangles, and whether each primitive is a triangle."""
    return zip(scene.shapes(), emitters.first_triangles, emitters.per_triangle)
