"""Cross-fitted coefficients of the first step: against loops, independent of the own group, and without bias in renders."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.control_variate import MIN_WEIGHT_VARIANCE
from bokehguide.guiding.cross_fitting import LEAST_EXPLAINED, REACH, cross_fitted
from bokehguide.guiding.pixel_groups import PixelGroups
from bokehguide.runtime.distributed import ROWS_PER_BAND
from bokehguide.scene.types import Scene
from tests.support.sharing_cases import FLOOR, loop_of, scene_of, terrace
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import rectangle

WIDTH, HEIGHT = 37, 20
PIXELS = WIDTH * HEIGHT
ALL = slice(0, PIXELS)
COLOR = np.array([0.2126, 0.7152, 0.0722])
KEYS = (0x5A3C71B2, 0x10F4D8E5, 0x7B0163AA, 0x2C9900FF)


def samples(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Radiance `[3, N]`, which follows the weights `[N]` more in columns farther right. Some samples are dark or not finite."""
    generator = np.random.default_rng(seed)
    weight = generator.gamma(4.0, 0.25, PIXELS)
    column, row = np.arange(PIXELS) % WIDTH, np.arange(PIXELS) // WIDTH
    follows = column / WIDTH
    level = follows * weight + (1.0 - follows) * generator.exponential(1.0, PIXELS)
    level[(column < 16) & (row < 8)] = 0.0
    radiance = np.array([[1.0], [0.6], [0.3]]) * (1.0 + row) * level
    radiance[1, generator.random(PIXELS) < 0.02] = math.nan
    weight[generator.random(PIXELS) < 0.02] = math.inf
    return torch.from_numpy(radiance).float(), torch.from_numpy(weight).float()


def by_light(radiance: Tensor) -> Tensor:
    """Radiance of two light groups, `[2, 3, N]`: less of the first farther to the right."""
    share = torch.linspace(0.9, 0.2, PIXELS)
    return torch.stack((share, 1.0 - share))[:, None] * radiance.nan_to_num()


def group_of(groups: PixelGroups, pixel: int) -> tuple[int, int, int, int]:
    """Band, row of tiles, tile and group of a pixel."""
    row = pixel // WIDTH
    x = pixel % WIDTH + groups.right[row % ROWS_PER_BAND]
    y = row % ROWS_PER_BAND + groups.below
    place = y % groups.down * groups.across + x % groups.across
    return row // ROWS_PER_BAND, y // groups.down, x // groups.across, (place & groups.mask).bit_count() % 2


def regression(radiance: np.ndarray, weight: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Slope of the luminance on the weight, share of the variance that the weight explains, and mean radiance."""
    light = COLOR @ radiance
    variance, covariance = weight.var(), np.mean((weight - weight.mean()) * (light - light.mean()))
    slope = covariance / max(variance, MIN_WEIGHT_VARIANCE)
    explained = covariance * slope / light.var() if light.var() > 0.0 else 0.0
    return slope, explained, radiance.mean(1)


def expected(groups: PixelGroups, radiance: np.ndarray, weight: np.ndarray, by_light: np.ndarray) -> tuple[np.ndarray, ...]:
    """Coefficients `[3, N]` and shares `[L, 3, N]`, group by group."""
    finite = np.isfinite(weight + radiance.sum(0))
    numbers = [group_of(groups, pixel) for pixel in range(PIXELS)]
    coefficients, shares = np.zeros((3, PIXELS)), np.zeros(by_light.shape)
    for group in set(numbers):
        band, _, tile, parity = group
        near = [each[0] == band and abs(each[2] - tile) <= REACH // groups.across and each != group for each in numbers]
        beside = [each[:3] == group[:3] and each[3] != parity for each in numbers]
        mine, near, beside = (np.array(which) for which in ([each == group for each in numbers], near, beside))
        slope, explained, color = regression(radiance[:, near & finite], weight[near & finite])
        light = COLOR @ color
        level = np.where(finite, COLOR @ radiance / np.maximum(weight, 1.0), 0.0)[beside]
        most = np.sort(level)[len(level) // 4] if len(level) else 0.0
        kept = max(min(slope, most), 0.0) if explained > LEAST_EXPLAINED else 0.0
        own = kept * color / light if light > 0.0 else np.zeros(3)
        parts = by_light[:, :, near & finite].sum(2)
        total = parts.sum(0)
        coefficients[:, mine] = own[:, None]
        shares[:, :, mine] = np.where(total > 0.0, parts / np.where(total > 0.0, total, 1.0), 1.0 / len(parts))[:, :, None]
    return coefficients, shares


@pytest.mark.parametrize("scattered", [True, False])
@pytest.mark.parametrize(("key", "size"), [*((key, 16) for key in KEYS), (KEYS[0], 2), (KEYS[1], 4), (KEYS[2], 64)])
def test_coefficients_and_shares_are_those_of_loops(key, size, scattered):
    groups = PixelGroups.of(WIDTH, size, key, scattered)
    radiance, weight = samples()
    split = torch.rand(2, 3, PIXELS, generator=torch.Generator().manual_seed(1)) * radiance.nan_to_num()
    split[0, :, (torch.arange(PIXELS) % WIDTH) > 20] = 0.0
    found = cross_fitted(ALL, groups, radiance, weight, split)
    for values, loops in zip(found, expected(groups, *(given.double().numpy() for given in (radiance, weight, split)))):
        np.testing.assert_allclose(values.double().numpy(), loops, rtol=1e-4, atol=1e-6)
    assert float(found[0][0].max()) > 0.5 and bool((found[0] == 0.0).any())


@pytest.mark.parametrize("light", [100.0, 1e15])
@pytest.mark.parametrize("key", KEYS)
def test_the_own_group_changes_no_bit(key, light):
    """The samples of a pixel and of the pixels whose hits the pixel may reuse, such as a glint of the sun."""
    groups = PixelGroups.of(WIDTH, 16, key, True)
    radiance, weight = samples()
    before = cross_fitted(ALL, groups, radiance, weight, by_light(radiance))
    members = groups.members(ALL, torch.device("cpu"))
    for pixel in (0, 20, 300, PIXELS - 1):
        own = torch.cat((torch.tensor([pixel]), members[:, pixel]))
        own = own[own >= 0]
        assert len(own) > 1
        changed = radiance.clone(), weight.clone()
        changed[0][:, own], changed[1][own] = light, 3.0
        after = cross_fitted(ALL, groups, *changed, by_light(changed[0]))
        assert torch.equal(after[0][:, own], before[0][:, own]) and torch.equal(after[1][..., own], before[1][..., own])
        assert not torch.allclose(after[0], before[0], rtol=1e-2)


def test_bands_of_rows_know_nothing_of_each_other():
    """So that batches, ranks and threads change no bit."""
    groups = PixelGroups.of(WIDTH, 16, KEYS[0], True)
    radiance, weight = samples()
    whole, _ = cross_fitted(ALL, groups, radiance, weight, None)
    for first in range(0, PIXELS, ROWS_PER_BAND * WIDTH):
        band = slice(first, min(first + ROWS_PER_BAND * WIDTH, PIXELS))
        for places in (band, torch.arange(band.start, band.stop)):
            part, _ = cross_fitted(places, groups, radiance[:, band], weight[band], None)
            assert torch.equal(part, whole[:, band])


def test_dark_surroundings_have_no_coefficient():
    """Columns 0 to 15 of the first band are dark. A tile beside the light may have a coefficient."""
    coefficient, _ = cross_fitted(ALL, PixelGroups.of(WIDTH, 16, KEYS[0], True), *samples(), None)
    assert not coefficient.reshape(3, HEIGHT, WIDTH)[:, :8, :8].any()


def even() -> Scene:
    """An even wall out of focus, whose hits pixels reuse: only the weights are noisy."""
    wall = replace(FLOOR, base_color=(0.0, 0.0, 0.0), specular=0.0, emission=(1.0, 0.8, 0.6))
    return scene_of([rectangle(0, (0.0, 0.2, -4.0), scale=9.0)], (wall,), 24, 16, sky=False)


def first_steps(scene: Scene, config: GuidedConfig, count: int) -> np.ndarray:
    """Pictures of one step and of `count` seeds, `[count, 3, H, W]`."""
    found = []
    for seed in range(count):
        with loop_of(scene, seed, config=config) as loop:
            loop.step()
        found.append(loop.film.radiance().permute(2, 0, 1).double().numpy())
    return np.stack(found)


@pytest.mark.slow
def test_the_first_step_has_the_mean_of_the_uncontrolled():
    scene, count = terrace(24, 16), 60
    controlled, plain = (first_steps(scene, GuidedConfig(control_variate=used), count) for used in (True, False))
    difference = (controlled - plain).mean(2).reshape(count, -1)  # by column
    assert np.abs(difference).max() > 1e-3
    t = difference.mean(0) / (difference.std(0, ddof=1) / math.sqrt(count)).clip(1e-7)
    z = stats.norm.isf(stats.t.sf(np.abs(t), count - 1))
    assert z_test(z, np.ones_like(z)) > SIGNIFICANCE


def test_the_noise_of_an_even_wall_falls():
    controlled, plain = (first_steps(even(), GuidedConfig(control_variate=used), 10) for used in (True, False))
    wall = np.array([1.0, 0.8, 0.6])[:, None, None]
    assert np.abs(plain - wall).mean() > 1e-3
    assert np.abs(controlled - wall).mean() < 0.3 * np.abs(plain - wall).mean()
