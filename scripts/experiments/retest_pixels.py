"""Single pixels rendered again in both renderers, with many more samples.

Light of rare paths, for example from an emitter over a mirror onto a diffuse table, reaches some pixels in a few of ten
thousand samples. A renderer that found none of them underestimates the pixel's mean and its variance. Such a pixel fails a
test that it passes in the limit. If the renderers disagree, more samples only confirm the failure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from experiments.mean_tests import FINE, finer
from experiments.mitsuba_scene import CHUNK_SAMPLES, MitsubaRenderer
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate
from tqdm import tqdm

from bokehguide.evaluation import LongRender, progress, warn_of_bad_samples, whole_step
from bokehguide.render.vector import luminance
from bokehguide.scene import Scene
from bokehguide.train import RenderLoop, RenderSettings

SAMPLES_FACTOR = 16
"""Samples of either renderer per sample of the first test."""
LEARNING_STEPS = 16
"""Steps in which guides learn from the whole frame, which has the size of the first test's. Most time of a retest goes here."""
FIRST_RUN, FIRST_CHUNK = 1_000, 1_000_000
"""First seeds of the two renderers; the first test uses none of them."""


@dataclass(frozen=True)
class PixelRetest:
    """The first test's scene and settings: `runs` runs of `spp` samples per pixel, and `mitsuba_spp` in Mitsuba."""

    scene: Scene
    mode: str
    runs: int
    spp: int
    mitsuba_spp: int
    threads: int | None = None

    def __call__(self, chosen: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Luminance of the pixels `chosen`, bool `[H, W]`: mean, its variance, Mitsuba's mean and its variance, float64 `[K]`."""
        return *self._in_bokehguide(chosen), *self._in_mitsuba(chosen)

    def _in_bokehguide(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        scene = finer(self.scene)
        steps = LEARNING_STEPS + math.ceil(SAMPLES_FACTOR * self.spp / FINE**2)
        mask = interpolate(chosen[None, None].float(), scale_factor=FINE).flatten() > 0.0
        mean, variance = torch.zeros(2, int(chosen.sum()), dtype=torch.float64)
        with progress(f"{scene.name} {self.mode}, retest", self.runs * steps) as bar:
            for seed in range(FIRST_RUN, FIRST_RUN + self.runs):
                with RenderLoop(scene, RenderSettings(self.mode, steps, seed, threads=self.threads)) as loop:
                    for step in range(steps):
                        if step == LEARNING_STEPS:
                            loop.render_only(mask)
                        whole_step(loop)
                        bar.update()
                warn_of_bad_samples(loop.film, f"{scene.name} {self.mode}, seed {seed}")
                light = luminance(loop.film.radiance().double().movedim(-1, 0))
                mean += avg_pool2d(light[None], FINE)[0][chosen] / self.runs
                variance += avg_pool2d(loop.film.variance().double()[None], FINE)[0][chosen] / (FINE * self.runs) ** 2
        return mean, variance

    def _in_mitsuba(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        renderer = MitsubaRenderer(self.scene)
        spp = max(2, min(CHUNK_SAMPLES, SAMPLES_FACTOR * self.mitsuba_spp))
        found = []
        for row, column in tqdm(chosen.nonzero().tolist(), desc=f"{self.scene.name} Mitsuba, retest", unit="pixel"):
            renderer.look_at(column, row)
            kept = LongRender(torch.zeros(1, 1, 3, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64))
            while kept.spp < SAMPLES_FACTOR * self.mitsuba_spp:
                kept = kept.plus(renderer.render(spp, FIRST_CHUNK + kept.chunks), spp)
            found.append((luminance(kept.radiance.movedim(-1, 0)).item(), kept.variance.item()))
        mean, variance = torch.tensor(found, dtype=torch.float64).T
        return mean, variance
