"""A second look at single pixels: rendered anew by both renderers with far more samples.

Light that comes by rare paths, as from a lamp over a mirror and a matt table, reaches some pixels by a few of ten
thousand samples. Where a renderer has met none of them it takes its mean, and the variance of it, for smaller than
they are, and the pixel fails a test it would pass in the limit. Where the renderers do disagree, more samples only make
that plainer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from mitsuba_scene import CHUNK_SAMPLES, MitsubaRenderer
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate
from tqdm import tqdm

from bokehguide.evaluation import LongRender, progress, warn_of_bad_samples, whole_step
from bokehguide.render.vector import luminance
from bokehguide.scene import Scene
from bokehguide.train import RenderLoop, RenderSettings

AGAIN = 16
"""So many times the samples of the first look, of either renderer."""
FINE = 16
"""Our pixels to one, across and down: the few that are left make batches that are worth their while."""
WHOLE = 16
"""Steps of ours in which guides learn from the whole frame, as they do in the first look."""
FIRST_RUN, FIRST_CHUNK = 1_000, 1_000_000
"""Seeds of ours and of Mitsuba's that the first look has not used; the later ones follow."""


@dataclass(frozen=True)
class SecondLook:
    """How to look again at a scene that was rendered in `runs` of `spp` samples a pixel, and by Mitsuba in `mitsuba_spp`."""

    scene: Scene
    mode: str
    runs: int
    spp: int
    mitsuba_spp: int
    threads: int | None = None

    def __call__(self, chosen: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Luminance of the pixels `chosen`, bool `[H, W]`: mean and its variance, Mitsuba's mean and its variance, float64 `[K]`."""
        return *self._ours(chosen), *self._mitsubas(chosen)

    def _ours(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        film = replace(self.scene.film, width=FINE * self.scene.film.width, height=FINE * self.scene.film.height)
        scene = replace(self.scene, film=film)
        steps = WHOLE + math.ceil(AGAIN * self.spp / FINE**2)
        places = interpolate(chosen[None, None].float(), scale_factor=FINE).flatten() > 0.0
        mean, variance = torch.zeros(2, int(chosen.sum()), dtype=torch.float64)
        with progress(f"{scene.name} {self.mode}, again", self.runs * steps) as bar:
            for seed in range(FIRST_RUN, FIRST_RUN + self.runs):
                loop = RenderLoop(scene, RenderSettings(self.mode, steps, seed, threads=self.threads))
                for step in range(steps):
                    if step == WHOLE:
                        loop.render_only(places)
                    whole_step(loop)
                    bar.update()
                warn_of_bad_samples(loop.film, f"{scene.name} {self.mode}, seed {seed}")
                light = luminance(loop.film.radiance().double().movedim(-1, 0))
                mean += avg_pool2d(light[None], FINE)[0][chosen] / self.runs
                variance += avg_pool2d(loop.film.variance().double()[None], FINE)[0][chosen] / (FINE * self.runs) ** 2
        return mean, variance

    def _mitsubas(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        renderer = MitsubaRenderer(self.scene)
        spp = max(2, min(CHUNK_SAMPLES, AGAIN * self.mitsuba_spp))
        found = []
        for row, column in tqdm(chosen.nonzero().tolist(), desc=f"{self.scene.name} Mitsuba, again", unit="pixel"):
            renderer.look_at(column, row)
            kept = LongRender(torch.zeros(1, 1, 3, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64))
            while kept.spp < AGAIN * self.mitsuba_spp:
                kept = kept.plus(renderer.render(spp, FIRST_CHUNK + kept.chunks), spp)
            found.append((luminance(kept.radiance.movedim(-1, 0)).item(), kept.variance.item()))
        mean, variance = torch.tensor(found, dtype=torch.float64).T
        return mean, variance
