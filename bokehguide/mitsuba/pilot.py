"""A pilot: a few samples of large pixels, which tell whether guiding the lens lowers the error of a picture."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bokehguide.mitsuba.frame import Frame
from bokehguide.mitsuba.lens import GuidedLens, LensSamples
from bokehguide.mitsuba.paths import Paths
from bokehguide.render.random import hash_int
from bokehguide.scene.types import FilmSettings, Scene

PIXELS = 1 << 13
"""Number of large pixels that a pilot aims at."""
STEPS, MEASURED = 8, 4
"""Samples of each large pixel, and how many of the last ones, of one distribution, measure the gain."""
EARLY = 2
"""Samples after which a pilot ends if the guide has found nothing that a pixel may see."""
POOL = 2
"""Side, in large pixels, of the squares over which moments are averaged."""
EPSILON = 0.01
"""Luminance, over the mean luminance, that is added to the denominator of relative errors."""
SEED = 0x91107


def expected_gain(paths: Paths, emitters: Scene, frame: Frame, seed: int, spp: int) -> float:
    """Ratio of the relative errors of the uniform and of the guided lens at equal SPP, averaged over the picture.

    emitters: the scene of the emitters, for the frame. The samples are independent of those of a render with the same seed.
    """
    cell = max(2, math.ceil(math.sqrt(len(frame.pixels) / PIXELS)))
    scene, rows, columns, start = large_pixels(emitters, frame, cell)
    pixels, step, seed = (rows[:, None] * scene.film.width + columns).ravel(), 0, hash_int(seed ^ SEED)
    with GuidedLens(scene, pixels, "guided", seed) as lens:
        while True:
            drawn = lens.draw(STEPS - step)
            placed = replace(drawn, raster=drawn.raster * np.float32(cell) + start, learned=True)
            seen = paths.trace(placed, hash_int(seed + step), spp, None)
            assert seen is not None
            step += len(drawn.weight) // len(pixels)
            if step == STEPS:
                return error_ratio(drawn, seen.radiance, (MEASURED, len(rows), len(columns)))
            lens.learn(seen)
            if step >= EARLY and not lens.guided().any():
                return 1.0


def large_pixels(emitters: Scene, frame: Frame, cell: int) -> tuple[Scene, np.ndarray, np.ndarray, np.ndarray]:
    """The scene with a film of pixels of `cell` × `cell` around the same centre; rows and columns of the pixels over the crop of
    the frame; and the first raster position, in pixels of the frame, `[2, 1]`."""
    sizes, spans = (frame.width, frame.height), []
    counts = [math.ceil(size / cell) for size in sizes]
    start = np.array([[(size - count * cell) / 2.0] for size, count in zip(sizes, counts)], np.float32)
    for first, places in zip(start.ravel(), (frame.pixels % frame.width, frame.pixels // frame.width)):
        low, high = ((int(place) + 0.5 - float(first)) // cell for place in (places.min(), places.max()))
        spans.append(np.arange(int(low), int(high) + 1))
    slope = math.tan(math.radians(frame.camera.fov) / 2.0) * counts[0] * cell / frame.width
    camera = replace(frame.camera, fov=math.degrees(2.0 * math.atan(slope)))
    return replace(emitters, camera=camera, film=FilmSettings(*counts)), spans[1], spans[0], start


def error_ratio(drawn: LensSamples, radiance: np.ndarray, shape: tuple[int, int, int]) -> float:
    """The ratio from the last samples of a pilot. shape: samples, rows and columns of these.

    With lens points of density q and weight w = u / q, f² w has the mean that f² has with the uniform density u.
    """
    count = math.prod(shape)
    light, weight = (each[-count:].astype(np.float64).reshape(shape) for each in (radiance, drawn.weight))
    guided, samples = light * weight, shape[0]
    total, squares = guided.sum(axis=0), (guided**2).sum(axis=0)
    mean = _pooled(total / samples)
    squared_mean = _pooled((total**2 - squares) / (samples * (samples - 1)))
    least = (EPSILON * max(mean.mean(), 1e-30)) ** 2
    own, uniform = (
        np.sqrt(np.maximum(_pooled(moment) - squared_mean, least))
        for moment in (squares / samples, (light**2 * weight).mean(axis=0))
    )
    relative = 1.0 / (mean + EPSILON * max(mean.mean(), 1e-30))
    return float((uniform * relative).sum() / (own * relative).sum())


def _pooled(values: np.ndarray) -> np.ndarray:
    """Means over squares of POOL × POOL large pixels, of values `[rows, columns]`; a short side is one square."""
    for axis in (0, 1):
        sums = np.add.reduceat(values, np.arange(0, values.shape[axis], POOL), axis=axis)
        counts = np.add.reduceat(np.ones(values.shape[axis]), np.arange(0, values.shape[axis], POOL))
        values = sums / (counts[:, None] if axis == 0 else counts)
    return values
