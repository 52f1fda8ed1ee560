"""Paths of many samples at once, in the variants of Mitsuba that compile kernels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from bokehguide.mitsuba.emitters import EmitterScene, luminance
from bokehguide.mitsuba.frame import Frame
from bokehguide.mitsuba.lens import LensSamples, SeenLight
from bokehguide.mitsuba.paths import Paths

ALIGNMENT = 64
"""Bytes to which the largest vectors of a processor are aligned."""


class Wavefront(Paths):
    """Many paths at once."""

    def __init__(self, nested: Any, scene: Any, sensor: Any, frame: Frame, emitters: EmitterScene):
        super().__init__(nested, scene, sensor, frame, emitters)
        self._triangles = TriangleNumbers(scene, emitters.first_triangles, emitters.per_triangle)

    def trace(self, drawn: LensSamples, seed: int, spp: int, block: Any | None) -> SeenLight | None:
        self._sampler.seed(dr.opaque(mi.UInt32, seed), len(drawn.weight))
        weight = shared(mi.Float, drawn.weight)
        active = weight > 0.0
        raster = drawn.raster - np.float32(self._frame.border)
        position = mi.Vector2f(shared(mi.Float, raster[0]), shared(mi.Float, raster[1]))
        # The x axis of the sensor points to the left.
        disc = mi.Point2f(shared(mi.Float, -drawn.points[0]), shared(mi.Float, drawn.points[1]))
        aperture = mi.warp.uniform_disk_to_square_concentric(dr.select(active, disc, 0.0))
        ray, value = self._paths(position, aperture, weight, active, spp, block)
        return self._seen(drawn, ray, value, active) if drawn.learned else None

    def trace_uniform(self, pixels: np.ndarray, count: int, seed: int, spp: int, block: Any) -> None:
        size, sampler = len(pixels) * count, self._sampler
        sampler.seed(dr.opaque(mi.UInt32, seed), size)
        number = dr.arange(mi.UInt32, size) // dr.opaque(mi.UInt32, count)
        pixel = dr.gather(mi.UInt32, shared(mi.UInt32, pixels), number)
        corner = mi.Vector2f(pixel % self._frame.width, pixel // self._frame.width) - self._frame.border
        position = corner + mi.Vector2f(sampler.next_2d())
        self._paths(position, sampler.next_2d(), mi.Float(1.0), mi.Bool(True), spp, block)

    def _paths(self, position: Any, aperture: Any, weight: Any, active: Any, spp: int, block: Any | None) -> tuple[Any, Any]:
        """Trace paths from positions on the film and put them on the block. Returns the camera rays, and radiance."""
        ray, ray_weight = self._rays(position, aperture, active)
        ray.scale_differential(spp**-0.5)
        value, valid, aovs = self._nested.sample(self._scene, self._sampler, ray, self._sensor.get_medium(), active)
        value = mi.unpolarized_spectrum(value) * ray_weight
        finite = active & dr.all(dr.isfinite(value))
        value = dr.select(finite, value, 0.0)
        if block is not None:
            place = dr.floor(position) if self._film.rfilter().is_box_filter() else position
            alpha = dr.select(valid & active, weight, 0.0)
            self._splat(block, place, value * weight, alpha, [each * weight for each in aovs], ray.wavelengths)
        return ray, value

    def _rays(self, position: Any, aperture: Any, active: Any) -> tuple[Any, Any]:
        """Rays through positions on the film and on the square of the lens, and their weights."""
        sensor, ((left, top), (across, down)) = self._sensor, (self._frame.corner, self._frame.size)
        time = sensor.shutter_open()
        if sensor.shutter_open_time() > 0.0:
            time += self._sampler.next_1d() * sensor.shutter_open_time()
        wavelength = self._sampler.next_1d() if mi.is_spectral else 0.0
        place = mi.Point2f((position.x - left) / across, (position.y - top) / down)
        return sensor.sample_ray_differential(time, wavelength, place, aperture, active)

    def _splat(self, block: Any, position: Any, value: Any, alpha: Any, channels: list[Any], wavelengths: Any) -> None:
        """Put samples on a block in the form of the film."""
        flags = self._film.flags()
        if mi.has_flag(flags, mi.FilmFlags.Special):
            block.put(position, self._film.prepare_sample(value, wavelengths, block.channel_count(), weight=1.0, alpha=alpha))
            return
        if mi.is_spectral:
            color = mi.spectrum_to_srgb(value, wavelengths)
        else:
            color = mi.Color3f(value[0]) if mi.is_monochromatic else value
        opaque = [alpha] if mi.has_flag(flags, mi.FilmFlags.Alpha) else []
        block.put(position, [color[0], color[1], color[2], *opaque, mi.Float(1.0), *channels])

    def _seen(self, drawn: LensSamples, ray: Any, value: Any, active: Any) -> SeenLight:
        """The report of the paths: their luminance, and their first surfaces."""
        surface = self._scene.ray_intersect_preliminary(ray, True, active)
        light, number = luminance(value, ray.wavelengths), self._triangles.of(surface)
        place, hit = ray(dr.select(surface.is_valid(), surface.t, 0.0)), dr.select(surface.is_valid(), 1.0, 0.0)
        dr.eval(light, place, number, hit)
        distance = self._distances(drawn, np.array(place), np.array(hit) > 0.0)
        return SeenLight(np.broadcast_to(np.array(light), distance.shape), distance, np.array(number, np.int64))


def shared(kind: Any, values: np.ndarray) -> Any:
    """Values of four bytes `[N]` as an array of Dr.Jit.

    Dr.Jit reads the memory of NumPy in place, and compiles a kernel for each alignment of its arrays. The memory here is always
    aligned alike, so that one kernel serves all steps.
    """
    room = np.empty(len(values) + ALIGNMENT // 4, np.uint32 if kind is mi.UInt32 else np.float32)
    start = -room.ctypes.data % ALIGNMENT // 4
    place = room[start : start + len(values)]
    place[:] = values
    return kind(place)


class TriangleNumbers:
    """The numbers of emitting triangles in the scene of emitters, for surfaces that rays hit."""

    def __init__(self, scene: Any, first_triangles: np.ndarray, per_triangle: np.ndarray):
        keys = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()), np.int64)
        first, each = np.full(keys.max(initial=0) + 1, -1, np.int64), np.zeros(keys.max(initial=0) + 1, np.int64)
        first[keys], each[keys] = first_triangles, per_triangle
        self._first, self._each = mi.Int32(first.astype(np.int32)), mi.Int32(each.astype(np.int32))
        self._count = len(first)

    def of(self, surface: Any) -> Any:
        """The numbers, -1 for surfaces that do not emit."""
        key: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
        known = surface.is_valid() & (key < self._count)
        first = dr.gather(mi.Int32, self._first, key, known)
        number = first + dr.gather(mi.Int32, self._each, key, known) * mi.Int32(surface.prim_index)
        return dr.select(known & (first >= 0), number, -1)
