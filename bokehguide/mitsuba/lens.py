"""The lens of another renderer, sampled by one of this package's modes: lens points for a step, and learning from its paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self, cast

import numpy as np
import torch
from torch import Tensor

from bokehguide.guiding.config import GaussianConfig, GuidedConfig
from bokehguide.guiding.emitter_guide import EmitterGuide
from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.guiding.guide import GuideRecord
from bokehguide.guiding.protocols import (
    BatchSamples,
    LensPoints,
    LensQuery,
    LensSampler,
    ModeContext,
    PixelBatch,
    StepSummary,
)
from bokehguide.guiding.uniform import UniformLens
from bokehguide.render import dimensions
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.epochs import starts_epoch
from bokehguide.render.film import FilmSamples
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom, hash_int
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.runtime.distributed import Ranks, available_cores
from bokehguide.runtime.workers import Workers
from bokehguide.scene.emitters import Emitters, find_emitters
from bokehguide.scene.types import Scene

MODES: dict[str, Callable[[ModeContext], LensSampler]] = {
    "uniform": UniformLens,
    "lis-b": lambda context: GaussianGuide(context, GaussianConfig(), True, False),
    "lis-o": lambda context: GaussianGuide(context, GaussianConfig(), True, True),
    "guided": lambda context: EmitterGuide(context, GuidedConfig(virtual_images=False)),
}
"""Lens samplers by mode. Virtual images need curvatures of surfaces, which other renderers do not tell."""
BATCH = 1 << 14
"""Pixels of a batch: the tensors of a batch stay in the cache of a core."""
LEARNED = 4
"""Steps of an epoch from which the lens learns. More of them would tell little that is new, and learning takes time."""
MOST_SAMPLES = 1 << 21
"""Largest number of samples of several steps that the renderer traces at once."""
RESTRICTED = 0x5E1EC7
"""Key of the random numbers of restricted pixels."""


@dataclass(frozen=True)
class LensSamples:
    """Samples of S steps for each of P pixels, N = S P in all, ordered by step.

    raster: positions in the frame, `[2, N]`. points: on the unit disc of the lens, x right and y up seen from behind the camera,
    `[2, N]`. weight: factor of the radiance, `[N]`, 0 outside the lens. learned: whether `learn` expects a report.
    """

    raster: np.ndarray
    points: np.ndarray
    weight: np.ndarray
    learned: bool


@dataclass(frozen=True)
class SeenLight:
    """What the renderer saw along the rays of `LensSamples`.

    radiance: luminance `[N]` of the path. distance: from the lens point to the first surface, `[N]`, infinite without one.
    triangle: of the scene of emitters, `[N]`, -1 for other surfaces.
    """

    radiance: np.ndarray
    distance: np.ndarray
    triangle: np.ndarray


@dataclass(frozen=True)
class _Drawn:
    """The samples of a batch of pixels in one step."""

    batch: PixelBatch
    query: LensQuery
    points: LensPoints


class _SceneEmitters(NamedTuple):
    """The part of a path tracer that lens samplers need without virtual images."""

    emitters: Emitters


class GuidedLens:
    """Draws lens points for the steps of a render, and learns from the reports.

    scene: the camera, and the emitters in its coordinates. pixels: of the frame that are rendered, int64 `[P]`. mode:
    one of MODES.
    """

    def __init__(self, scene: Scene, pixels: np.ndarray, mode: str, seed: int):
        self._camera = ThinLensCamera(scene.camera, scene.film.width, scene.film.height)
        self._seed, self._step, self._last, self._mean = seed, 0, 0, 1.0
        self._light = self._count = 0.0
        everywhere = torch.ones(self._camera.width * self._camera.height, dtype=torch.bool)
        tracer = cast(PathTracer, _SceneEmitters(find_emitters(scene)))
        size = scene.film.width, scene.film.height
        self._sampler = MODES[mode](ModeContext(scene, self._camera, tracer, *size, None, Ranks(), everywhere))
        self._by_epoch = not isinstance(self._sampler, GaussianGuide)
        self._set_pixels(pixels)
        self._everywhere = True
        self._workers = Workers(available_cores(), torch.device("cpu"))
        self._drawn: list[list[_Drawn]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the threads."""
        self._workers.close()

    def guided(self) -> np.ndarray:
        """Whether a pixel may see an emitter or highlight that the lens knows, bool `[P]`."""
        candidates = self._sampler.candidates if isinstance(self._sampler, EmitterGuide) else None
        return np.zeros(self._size, bool) if candidates is None else candidates.counts().numpy()[self._pixels] > 0

    def restrict(self, pixels: np.ndarray) -> None:
        """Draw samples of these pixels only from now on.

        The choice of the pixels may depend on earlier samples, so the later random numbers are those of another seed.
        """
        self._set_pixels(pixels)
        self._seed, self._everywhere = hash_int(self._seed ^ RESTRICTED), False

    def draw(self, rest: int) -> LensSamples:
        """The samples of the next steps, as many as have one distribution and are alike in being learned.

        rest: number of steps until the end of the render.
        """
        self._last = self._step + rest
        learned, steps = self._is_learned(self._step + 1), 1
        limit = min(rest, max(MOST_SAMPLES // self._size, 1)) if self._by_epoch else 1
        while steps < limit and not starts_epoch(self._step + steps + 1) and self._is_learned(self._step + steps + 1) == learned:
            steps += 1
        self._drawn = []
        with self._workers.serial():
            for _ in range(steps):
                self._step += 1
                self._drawn.append(self._workers.map(self._draw, self._spans))
        batches = [drawn for step in self._drawn for drawn in step]
        raster = torch.cat([drawn.batch.raster for drawn in batches], dim=1).numpy()
        points = torch.cat([drawn.points.points for drawn in batches], dim=1).numpy()
        weight = torch.cat([drawn.points.weight for drawn in batches]).numpy()
        return LensSamples(raster, points / np.float32(self._camera.lens.radius), weight, learned)

    def learn(self, seen: SeenLight) -> None:
        """Learn from the paths of the samples that were drawn last, which `learned` has asked for."""
        finite = np.nan_to_num(seen.radiance, nan=0.0, posinf=0.0, neginf=0.0)
        if self._everywhere:
            weight = np.concatenate([drawn.points.weight.numpy() for step in self._drawn for drawn in step])
            self._light += float(np.dot(finite.astype(np.float64), weight))
            self._count += len(weight)
            self._mean = self._light / self._count
        first = self._step - len(self._drawn) + 1
        for number, step in enumerate(self._drawn):
            part = slice(number * self._size, (number + 1) * self._size)
            self._learn_step(first + number, step, SeenLight(finite[part], seen.distance[part], seen.triangle[part]))

    def _set_pixels(self, pixels: np.ndarray) -> None:
        self._pixels, self._size = pixels, len(pixels)
        self._spans = [torch.from_numpy(part) for part in np.split(pixels, range(BATCH, len(pixels), BATCH))]

    def _is_learned(self, step: int) -> bool:
        """Whether the lens learns from a step: from the last steps of each epoch before the last epoch."""
        later = range(step + 1, min(step + LEARNED, self._last) + 1)
        return self._sampler.learns and (any(map(starts_epoch, later)) if self._by_epoch else step < self._last)

    def _learn_step(self, step: int, drawn: list[_Drawn], seen: SeenLight) -> None:
        """Learn from one step."""
        ends = np.cumsum([len(one.points.weight) for one in drawn])[:-1]
        parts = zip(*(np.split(part, ends) for part in (seen.radiance, seen.distance, seen.triangle)))
        samples = [_samples(self._camera, one, SeenLight(*part)) for one, part in zip(drawn, parts)]
        with self._workers.serial():
            records: Sequence[GuideRecord] = self._workers.map(self._record, samples)
        summary = StepSummary(step, self._mean, lambda: torch.zeros(0))  # no mode above asks for a picture
        self._sampler.accumulate(records, summary)
        self._sampler.update(summary)

    def _draw(self, pixels: Tensor) -> _Drawn:
        """One sample for each of the given pixels."""
        camera, random = self._camera, PixelRandom(self._seed, self._step, pixels)
        corner = torch.stack((pixels % camera.width, pixels // camera.width))
        raster = corner + random.stratified(dimensions.FILM, 2)
        focus = camera.focus_points(raster)
        batch = PixelBatch(self._step, pixels, pixels, raster, raster - corner, focus, random, self._mean)
        query = self._sampler.query(batch)
        return _Drawn(batch, query, query.sample())

    def _record(self, samples: BatchSamples) -> GuideRecord:
        return cast(GuideRecord, self._sampler.record(samples, torch.ones(len(samples.drawn.weight), dtype=torch.bool)))


def _samples(camera: ThinLensCamera, drawn: _Drawn, seen: SeenLight) -> BatchSamples:
    """A report of the renderer in the form that lens samplers take."""
    light, distance = torch.from_numpy(seen.radiance).float(), torch.from_numpy(seen.distance).float()
    hit, triangle = distance.isfinite(), torch.from_numpy(seen.triangle)
    # The first triangle is black; it stands for all surfaces without proposals.
    numbers = torch.where(hit, triangle.clamp(min=0), -1).to(torch.int32)
    emission = torch.where(triangle >= 0, light, 0.0)  # whatever else such a surface sends is little
    grey, none = light.expand(3, -1), torch.zeros(3, len(light))
    paths = PathSamples(
        grey, torch.where(hit, distance, MISS_DISTANCE), none, none, emission.expand(3, -1), hit.float(), numbers, 0, None
    )
    film = FilmSamples(drawn.points.weight, grey, paths.alpha, paths.distance, none, none, none)
    _, directions = camera.rays(drawn.batch.focus, drawn.points.points)
    return BatchSamples(drawn.batch, drawn.query, drawn.points, directions, paths, (), (), film)
