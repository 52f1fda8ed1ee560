"""Means of renders: a furnace, and guided means against uniform ones.

Each check returns p-values, so that a deliberate defect can be shown to fail it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.models.ellipse_mixture import balls
from bokehguide.render.film import Film
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLoop, RenderSettings, StepStats
from tests.support import scenes
from tests.support.statistical import block_means, z_test

FINE = (256, 144)
"""Rendered size. Blocks of 8 × 8 pixels are compared: one sample per pixel is 64 samples of a pixel of a 32 × 18 picture."""
REFERENCE_SPP, GUIDED_SPP = 256, 48  # times 64: 16,384 and 3,072
FINER_SPP = 4 * REFERENCE_SPP
"""For `guided`, which finds slivers of emitters that REFERENCE_SPP samples of the uniform lens miss: the reference would be dark
there, with an estimated variance of 0."""


@dataclass
class Estimate:
    """Mean luminance and its variance by pixel, `[H, W]`, and the statistics of the last step."""

    mean: np.ndarray
    variance: np.ndarray
    last: StepStats

    def p_value(self, expected: np.ndarray | float, expected_variance: np.ndarray | float, sizes: tuple[int, ...]) -> float:
        """The least p-value of z-tests over blocks of these sizes and over the frame."""
        difference = self.mean - expected
        variance = self.variance + expected_variance
        blocks = [z_test(block_means(difference, n), np.sqrt(block_means(variance, n)) / n) for n in sizes]
        return min(*blocks, z_test(difference.mean(), np.sqrt(variance.mean() / variance.size)))


def estimate(loop: RenderLoop, steps: int) -> Estimate:
    """Run some steps, end the loop's workers and read the film."""
    with loop:
        for _ in range(steps):
            last = loop.step()
    mean = luminance(loop.film.radiance().reshape(-1, 3).T).reshape(loop.film.height, loop.film.width)
    return Estimate(mean.double().numpy(), loop.film.variance().double().numpy(), last)


def insert_gaussians(loop: RenderLoop, count: int, seed: int) -> None:
    """Give the guide `count` Gaussians before and behind the focal plane, which no fit replaces."""
    generator = torch.Generator().manual_seed(seed)
    focus_distance = loop.camera.lens.focus_distance
    depth = focus_distance * torch.where(
        torch.rand(count, generator=generator) < 0.4,
        0.5 + 0.3 * torch.rand(count, generator=generator),
        1.5 + 8.0 * torch.rand(count, generator=generator).square(),
    )
    pixel = torch.rand(2, count, generator=generator) * torch.tensor([[loop.camera.width], [loop.camera.height]])
    mean = torch.cat((loop.camera.slopes(pixel) * depth, depth[None]))
    k = focus_distance / (focus_distance - depth).abs()
    sigma = loop.camera.lens.radius * (0.2 + 0.4 * torch.rand(count, generator=generator)) / k
    guide = loop.mode.lens
    guide.field.assign(mean, 2.0 * sigma, sigma, torch.exp(torch.randn(count, generator=generator)) * sigma * sigma)
    guide.refit = lambda mean_luminance: guide.set_candidates()
    if isinstance(guide, GaussianGuide):
        guide.uniform.zero_()
    else:
        guide.outlines = balls(sigma)
    guide.set_candidates()


def furnace(mode: str, steps: int = 128, seed: int = 3, controlled: bool = True) -> Estimate:
    """Radiance 1 everywhere through a wide lens, guided by 20 Gaussians from the second step on.

    controlled: whether `guided` has its control variate, which removes the noise of the weights: all noise that a furnace has.
    """
    config = GuidedConfig(control_variate=controlled)
    loop = RenderLoop(scenes.furnace(80, 48), RenderSettings(mode, seed=seed, threads=1, guided=config))
    loop.step()
    if mode != "uniform":
        insert_gaussians(loop, 20, seed)
    return estimate(loop, steps - 1)


def one_everywhere(found: Estimate) -> float:
    """The least p-value over pixels, blocks of 8 × 8 and the frame."""
    return found.p_value(1.0, 0.0, (1, 8))


@lru_cache
def uniform_reference(spp: int = REFERENCE_SPP) -> Estimate:
    """The emitters through the uniform lens."""
    return estimate(RenderLoop(emitter_scene(), RenderSettings("uniform", seed=1000, threads=1)), spp)


def emitter_scene() -> Scene:
    return scenes.emitters(*FINE)


def learning(mode: str, seed: int = 1, steps: int = GUIDED_SPP) -> Estimate:
    """The emitters, with every sample from the first on in the mean."""
    return estimate(RenderLoop(emitter_scene(), RenderSettings(mode, seed=seed, threads=1)), steps)


def frozen(mode: str, seed: int = 2, steps: int = GUIDED_SPP) -> Estimate:
    """The emitters on a new film, after a guide that has learned for 16 steps stops learning."""
    loop = RenderLoop(emitter_scene(), RenderSettings(mode, seed=seed, threads=1))
    for _ in range(16):
        loop.step()
    loop.film = Film(*FINE)
    loop.mode.lens.update = lambda summary: None
    return estimate(loop, steps)


def means_check(guided: Estimate, spp: int = REFERENCE_SPP) -> float:
    """The least p-value over pixels (8 × 8 fine ones), blocks of 2 × 2 of them and the frame; spp: of the reference."""
    reference = uniform_reference(spp)
    return guided.p_value(reference.mean, reference.variance, (8, 16))
