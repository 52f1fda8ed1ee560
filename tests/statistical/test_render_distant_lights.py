"""Suns: what they send, how they are sampled beside a map, and what camera rays see at infinity."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render.lights.distant import DistantLight
from bokehguide.render.lights.environment import EnvironmentLight
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Environment, FilmSettings, Material, Sun
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.rooms import bsdf_sampling_only
from tests.support.sphere import SphereGrid
from tests.support.statistical import SIGNIFICANCE, block_means, chi_square, z_test
from tests.support.tracing import UP, agreement, estimates, matte, mean_test, rectangle, scene, sky, trace

TILTED = (0.36, 0.8, -0.48)


def sun(direction=TILTED, angle: float = 0.53, irradiance: float = 1.0) -> Sun:
    return Sun(direction, angle, (irradiance, 2.0 * irradiance, 3.0 * irradiance))


def uniforms(count: int, dimensions: int) -> torch.Tensor:
    return PixelRandom(5, 0, torch.arange(count)).uniform(0, dimensions)


def window(visible: bool = True) -> Environment:
    radiance = np.full((16, 32, 3), 0.2, np.float32)
    radiance[2:6, 3:9] = 5.0
    return Environment(radiance, 40.0, visible)


def floor(suns, environment=None, material=None, max_depth: int = 2):
    """A floor of side 4 at the origin."""
    lit = scene([rectangle(0, rotate=UP, scale=2.0)], [material or matte(0.5)], environment, max_depth)
    return replace(lit, suns=tuple(suns))


@pytest.mark.parametrize("angle", [0.01, 0.53, 20.0, 90.0])
@pytest.mark.parametrize("direction", [TILTED, (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)])
def test_draws_spread_evenly_over_the_disc(direction, angle):
    """In height above the rim and angle about the axis, which share a disc of the sphere evenly."""
    disc = DistantLight(sun(direction, angle))
    drawn = disc.sample(uniforms(200_000, 2))
    assert torch.allclose(drawn.norm(dim=0), torch.ones(()), atol=1e-6)
    assert disc.contains(drawn).mean() > 0.999  # rounding takes a few across the rim
    towards = torch.tensor(direction, dtype=torch.float64)
    offset = drawn.double() - towards[:, None]
    height = 0.5 * (offset**2).sum(0) / (1.0 - math.cos(math.radians(0.5 * angle)))
    assert height.min() > -1e-3 and height.max() < 1.0 + 1e-3
    across = torch.linalg.cross(towards, torch.tensor([0.3, 0.5, 0.6], dtype=torch.float64))
    across = across / across.norm()
    other = torch.linalg.cross(towards, across)
    phi = torch.atan2(other @ offset, across @ offset) / (2.0 * math.pi) + 0.5
    cell = (height * 8).long().clamp(0, 7) * 16 + (phi * 16).long().clamp(0, 15)
    assert chi_square(np.bincount(cell, minlength=128), np.full(128, 1.0 / 128.0)) > SIGNIFICANCE


@pytest.mark.parametrize("angle", [0.05, 0.53, 20.0, 90.0])
def test_radiance_within_the_disc_adds_up_to_the_irradiance(angle):
    """On a facing surface: draws, weighed by their cosine, over their density."""
    light = EnvironmentLight(None, (sun(angle=angle, irradiance=7.0),))
    direction, pdf = light.sample(uniforms(1_000_000, 5))
    cosine = torch.tensor(TILTED) @ direction
    worth = (light.radiance(direction) * cosine / pdf.clamp(min=1e-30)).double().numpy()
    assert mean_test(worth, (7.0, 14.0, 21.0), 2e-4) > SIGNIFICANCE
    assert worth[0].mean() == pytest.approx(7.0, rel=2e-3)
    middle = torch.tensor(TILTED)[:, None]
    assert light.power == pytest.approx(float(luminance(light.radiance(middle)) / light.pdf(middle)), rel=1e-3)


def mixtures() -> dict[str, EnvironmentLight]:
    wide = (sun(angle=40.0), sun((0.0, 0.6, 0.8), 25.0, 3.0), sun((0.0, 0.8, 0.6), 30.0))
    return {
        "a sun": EnvironmentLight(None, wide[:1]),
        "suns": EnvironmentLight(None, wide),
        "map": EnvironmentLight(window()),
        "map and sun": EnvironmentLight(window(), wide[:1]),
        "map and suns": EnvironmentLight(window(), wide),
        "even map and suns": EnvironmentLight(sky(1.0), wide),
    }


@pytest.mark.parametrize("name", mixtures())
def test_draws_follow_the_density_of_the_whole_mixture(name):
    """The second and third sun overlap."""
    light, grid = mixtures()[name], SphereGrid(8, 16, 96)
    probability = grid.cell_integrals(light.pdf(grid.directions))
    assert probability.sum() == pytest.approx(1.0, abs=1e-3)  # rims cross the quadrature's points
    drawn, pdf = light.sample(uniforms(100_000, 5))
    assert ((light.pdf(drawn) / pdf - 1.0).abs() > 1e-4).float().mean() < 1e-4  # rounding at the texels' edges
    assert chi_square(grid.histogram(drawn), probability / probability.sum()) > SIGNIFICANCE


@pytest.mark.parametrize("name", mixtures())
def test_weighted_draws_add_up_to_all_light_but_what_is_even(name):
    light, grid = mixtures()[name], SphereGrid(8, 16, 96)
    sampled = light.pdf(grid.directions) > 0.0
    expected = grid.integral(light.radiance(grid.directions) * sampled)
    drawn, pdf = light.sample(uniforms(100_000, 5))
    worth = (light.radiance(drawn) / pdf.clamp(min=1e-30)).double().numpy()
    assert mean_test(worth, expected, 2e-3) > SIGNIFICANCE


@pytest.mark.parametrize("angle", [0.53, 60.0])
def test_a_lambertian_floor_sends_back_the_irradiance_times_the_cosine(angle):
    """Of a disc that is above the floor as a whole, whatever its size."""
    radiance = estimates(floor([sun(angle=angle, irradiance=math.pi)]), (0.0, 1.0, 0.0), (0.1, -1.0, 0.2))
    assert mean_test(radiance, 0.5 * TILTED[1] * np.array([1.0, 2.0, 3.0]), 1e-4) > SIGNIFICANCE
    assert radiance[0].mean() == pytest.approx(0.5 * TILTED[1], rel=0.02)


def test_suns_and_map_add_up_on_a_floor():
    suns, ray = [sun(irradiance=2.0), sun((0.0, 0.6, 0.8), 5.0)], ((0.0, 1.0, 0.0), (0.1, -1.0, 0.2))
    together = estimates(floor(suns, window()), *ray, 100_000)
    apart = estimates(floor([], window()), *ray, 100_000, 1) + estimates(floor(suns), *ray, 100_000, 2)
    assert agreement(together, apart) > SIGNIFICANCE


@pytest.mark.slow
@pytest.mark.parametrize("environment", [None, window()], ids=["suns", "map and suns"])
@pytest.mark.parametrize("material", [matte(0.6), Material("metal", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.2)])
def test_both_techniques_together_agree_with_one_alone(environment, material, monkeypatch):
    lit = floor([sun((-0.5, 0.6, -0.62), 30.0), sun(angle=50.0)], environment, material)
    ray = (1.0, 1.0, 1.0), (-1.0, -1.0, -1.0)
    together = estimates(lit, *ray, 50_000)
    bsdf_sampling_only(monkeypatch)
    assert agreement(together, estimates(lit, *ray, 200_000, 1)) > SIGNIFICANCE


def test_a_sun_is_seen_as_a_disc():
    found = trace(floor([sun()]), (0.0, 1.0, 0.0), TILTED, 10)
    radiance = np.array([1.0, 2.0, 3.0]) / (math.pi * math.sin(math.radians(0.265)) ** 2)
    np.testing.assert_allclose(found.radiance[:, 0], radiance, rtol=1e-4)
    assert found.alpha.tolist() == [1.0] * 10 and not found.emission.any() and not found.albedo.any()
    for turn, alpha in ((0.26, 1.0), (0.27, 0.0)):
        side = np.cross(TILTED, (0.0, 1.0, 0.0))
        rim = np.asarray(TILTED) + math.tan(math.radians(turn)) * side / np.linalg.norm(side)
        found = trace(floor([sun()]), (0.0, 1.0, 0.0), rim, 1)
        assert found.alpha[0] == alpha and bool(found.radiance.any()) == (alpha > 0.0)


def test_where_suns_overlap_alpha_is_one():
    """And radiances add up."""
    one, other = sun(angle=20.0), sun((0.4, 0.8, -0.45), 30.0)
    found = trace(floor([one, other]), (0.0, 1.0, 0.0), TILTED, 10)
    apart = [trace(floor([each]), (0.0, 1.0, 0.0), TILTED, 10) for each in (one, other)]
    assert found.alpha.tolist() == [each.alpha[0] for each in apart] * 5 == [1.0] * 10
    torch.testing.assert_close(found.radiance, apart[0].radiance + apart[1].radiance)


@pytest.mark.parametrize("suns", [[], [sun()]], ids=["map", "map and sun"])
def test_an_environment_that_is_not_visible_lights_the_scene_all_the_same(suns):
    shown, hidden = floor(suns, window()), floor(suns, window(False))
    for direction in ((0.0, 0.6, 0.8), TILTED):
        above = trace(hidden, (0.0, 1.0, 0.0), direction, 4)
        assert not above.radiance.any() and not above.alpha.any()
        above = trace(shown, (0.0, 1.0, 0.0), direction, 4)
        assert above.radiance.all() and above.alpha.all()
    ray = (0.0, 1.0, 0.0), (0.1, -1.0, 0.2)
    assert torch.equal(trace(hidden, *ray, 1000).radiance, trace(shown, *ray, 1000).radiance)
    assert trace(hidden, *ray, 4).alpha.all()


def test_what_is_not_visible_is_seen_in_a_mirror():
    mirror = Material("mirror", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
    lit = floor([], Environment(sky(2.0).radiance, visible=False), mirror)
    found = trace(lit, (0.0, 1.0, 0.0), (0.3, -1.0, 0.0), 100)
    np.testing.assert_allclose(found.radiance.mean(1), 2.0, rtol=0.02)


def sunset(width: int, height: int):
    """A sun out of focus behind nothing, and a small black ball out of the way."""
    empty = scenes.furnace(width, height)
    return replace(
        empty,
        film=FilmSettings(width, height, max_depth=1),
        camera=replace(empty.camera, fov=40.0, aperture_radius=0.1),
        environment=None,
        suns=(Sun((0.05, 0.0, -1.0), 0.53, (1.0, 1.0, 1.0)),),
    )


def test_the_guide_finds_the_sun():
    modes = ("uniform", "lis-o")
    loops = {mode: RenderLoop(sunset(160, 96), RenderSettings(mode, seed=1, threads=1)) for mode in modes}
    for loop in loops.values():
        for _ in range(24):
            stats = loop.step()
    assert stats.gaussians > 0
    means = {mode: luminance(loop.film.radiance().permute(2, 0, 1)).numpy() for mode, loop in loops.items()}
    variances = {mode: loop.film.variance().numpy() for mode, loop in loops.items()}
    difference = block_means(means["lis-o"] - means["uniform"], 16)
    error = np.sqrt(block_means(variances["lis-o"] + variances["uniform"], 16)) / 16
    lit = block_means(means["uniform"], 16) > 0.5 * means["uniform"].mean()
    assert z_test(difference[lit], error[lit]) > SIGNIFICANCE
    assert variances["lis-o"].mean() < 0.3 * variances["uniform"].mean()
    alpha = loops["lis-o"].film.layers()["alpha"]
    assert 0.0 < alpha.mean() < 0.05
