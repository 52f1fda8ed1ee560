"""Renders that must come out right on average: a furnace, and guided means against uniform ones.

Each check returns p-values, so that a deliberate defect can be shown to fail it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scenes
import torch
from statistical import block_means, z_test

from bokehguide.models.disc_distribution import balls
from bokehguide.render.film import Film
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLoop, RenderSettings, StepStats
from bokehguide.train.guide import LensGuide

FINE = (256, 144)
"""Rendered size. Its blocks of 8 × 8 pixels are the pixels that are compared: a sample per
fine pixel is 64 samples of a pixel of a 32 × 18 picture."""
REFERENCE_SPP, GUIDED_SPP = 256, 48  # times 64: 16,384 and 3,072
FINER_SPP = 4 * REFERENCE_SPP
"""For `guided`, which finds slivers of lamps that so many rays of the uniform lens miss: there the reference would be a dark
one that is sure of it."""


@dataclass
class Estimate:
    """Mean luminance and its variance by pixel, `[H, W]`, and what the last step told."""

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
    """Run some steps and read the film."""
    for _ in range(steps):
        last = loop.step()
    mean = luminance(loop.film.radiance().reshape(-1, 3).T).reshape(loop.film.height, loop.film.width)
    return Estimate(mean.double().numpy(), loop.film.variance().double().numpy(), last)


def put_in(loop: RenderLoop, count: int, seed: int) -> None:
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
    loop.guide.field.assign(mean, 2.0 * sigma, sigma, torch.exp(torch.randn(count, generator=generator)) * sigma * sigma)
    loop.guide.refit = lambda mean_luminance: loop.guide.set_candidates()
    if isinstance(loop.guide, LensGuide):
        loop.guide.held.zero_()
    else:
        loop.guide.outlines = balls(sigma)
    loop.guide.set_candidates()


def furnace(mode: str, steps: int = 128, seed: int = 3, controlled: bool = True) -> Estimate:
    """Radiance 1 everywhere through a wide lens, guided by 20 Gaussians put in after the first step.

    controlled: whether `guided` may take the noise of the weights away, which is all there is here.
    """
    loop = RenderLoop(scenes.furnace(80, 48), RenderSettings(mode, seed=seed, threads=1))
    if not controlled:
        loop.control = None
    loop.step()
    if loop.guide is not None:
        put_in(loop, 20, seed)
    return estimate(loop, steps - 1)


def one_everywhere(found: Estimate) -> float:
    """The least p-value over pixels, blocks of 8 × 8 and the frame."""
    return found.p_value(1.0, 0.0, (1, 8))


@lru_cache
def uniform_reference(spp: int = REFERENCE_SPP) -> Estimate:
    """The lamps from the uniform lens."""
    return estimate(RenderLoop(lamp_scene(), RenderSettings("uniform", seed=1000, threads=1)), spp)


def lamp_scene() -> Scene:
    return scenes.lamps(*FINE)


def learning(mode: str, seed: int = 1, steps: int = GUIDED_SPP) -> Estimate:
    """The lamps, with every sample from the first on in the mean."""
    return estimate(RenderLoop(lamp_scene(), RenderSettings(mode, seed=seed, threads=1)), steps)


def frozen(mode: str, seed: int = 2, steps: int = GUIDED_SPP) -> Estimate:
    """The lamps on a fresh film, after a guide that has learnt for 16 steps stops learning."""
    loop = RenderLoop(lamp_scene(), RenderSettings(mode, seed=seed, threads=1))
    estimate(loop, 16)
    loop.film = Film(*FINE)
    loop.guide.update = lambda step, lessons, mean_luminance: None
    return estimate(loop, steps)


def means_check(guided: Estimate, spp: int = REFERENCE_SPP) -> float:
    """The least p-value over pixels (8 × 8 fine ones), blocks of 2 × 2 of them and the frame; spp: of the reference."""
    reference = uniform_reference(spp)
    return guided.p_value(reference.mean, reference.variance, (8, 16))
