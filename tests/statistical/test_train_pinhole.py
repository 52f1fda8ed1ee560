"""The mode `guided` through a pinhole: one lens point, and a learned choice of light samples."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from bokehguide.guiding.learned_lights import LearnedLights
from bokehguide.guiding.uniform import UniformLens
from bokehguide.render.vector import luminance
from bokehguide.runtime import native
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.statistical import SIGNIFICANCE, block_means, z_test
from tests.support.tracing import sky

SIZE = 96, 54
RENDERS, STEPS = 24, 12
REFERENCE_SPP = 1024


@lru_cache
def pinhole(lit: str) -> Scene:
    """fairy-lights through a pinhole, without a map or under an even sky."""
    scene = load_scene("fairy-lights", Overrides(width=SIZE[0], height=SIZE[1], aperture_radius=0.0))
    return replace(scene, environment=sky(0.05)) if lit == "sky" else scene


def gray(loop: RenderLoop) -> np.ndarray:
    return luminance(loop.film.radiance().reshape(-1, 3).T).reshape(SIZE[1], SIZE[0]).double().numpy()


@lru_cache
def pictures(lit: str, mode: str, core: str = "1") -> np.ndarray:
    """Luminance of renders with one seed each, `[RENDERS, H, W]`."""
    found = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(native.SWITCH, core)
        for seed in range(RENDERS):
            with RenderLoop(pinhole(lit), RenderSettings(mode, seed=seed, threads=1)) as loop:
                for _ in range(STEPS):
                    loop.step()
                found.append(gray(loop))
    return np.stack(found)


@lru_cache
def reference(lit: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean luminance and its variance by pixel, in mode `uniform`."""
    with RenderLoop(pinhole(lit), RenderSettings("uniform", seed=1_000, threads=1)) as loop:
        for _ in range(REFERENCE_SPP):
            loop.step()
        return gray(loop), loop.film.variance().double().numpy()


def noise(found: np.ndarray) -> float:
    return float((found.std(0, ddof=1) / (found.mean(0) + 0.01)).mean())


@pytest.mark.slow
@pytest.mark.parametrize(("lit", "core"), [("lamps", "1"), ("lamps", "0"), ("sky", "1")])
def test_means_while_learning_are_those_of_mode_uniform(lit, core):
    found, (expected, variance) = pictures(lit, "guided", core), reference(lit)
    difference = block_means(found.mean(0) - expected, 6)
    error = np.sqrt(block_means(found.var(0, ddof=1) / RENDERS + variance, 6)) / 6
    assert z_test(difference, error) > SIGNIFICANCE
    assert z_test(1.02 * difference + 0.02 * block_means(expected, 6), error) < SIGNIFICANCE  # 2 % would be found


@pytest.mark.slow
@pytest.mark.parametrize("lit", ["lamps", "sky"])
def test_the_choice_of_lights_lowers_the_noise(lit):
    assert noise(pictures(lit, "guided")) < 0.6 * noise(pictures(lit, "uniform"))


def test_a_sample_has_one_lens_point_and_several_paths():
    with (
        RenderLoop(pinhole("lamps"), RenderSettings("guided", threads=1)) as guided,
        RenderLoop(pinhole("lamps"), RenderSettings("uniform", threads=1)) as uniform,
    ):
        assert isinstance(guided.mode.lens, UniformLens) and isinstance(guided.mode.lights, LearnedLights)
        assert 1.5 * uniform.step().rays < guided.step().rays < 2.0 * uniform.step().rays
