"""Thin films and dispersion: values against the extensions' formulas, sampling, energy, and brute force."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render.bsdf.dielectric import DielectricBSDF
from bokehguide.render.bsdf.mixture import disperse
from bokehguide.render.bsdf.opaque import OpaqueBSDF
from bokehguide.render.bsdf.thin_film import film_reflectance
from bokehguide.render.random import PixelRandom
from bokehguide.scene.types import Environment, Material
from tests.support.scattering_formulas import iridescent, mirrors
from tests.support.sphere import SphereGrid, surface, tilted
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import estimates, scene, sphere

GRID = SphereGrid()
POINTS = GRID.directions.shape[1]
DRAWS = 200_000
WHITE = (1.0, 1.0, 1.0)
COSINES = torch.linspace(0.01, 1.0, 200)
FILMS = [(1.3, 400.0), (1.8, 250.0), (2.2, 900.0), (1.33, 80.0)]


def uniforms(count: int, seed: int = 0) -> torch.Tensor:
    return PixelRandom(seed, 0, torch.arange(count)).uniform(0, 3)


def film(ior: float, thickness: float, share: float = 1.0, **others) -> dict:
    return {"iridescence": share, "film_ior": ior, "film_thickness": thickness, **others}


@pytest.mark.parametrize("ior, thickness", FILMS)
@pytest.mark.parametrize("f0", [(0.04, 0.04, 0.04), (0.9, 0.6, 0.3)])
def test_reflectances_are_those_of_the_extension(f0, ior, thickness):
    count = len(COSINES)
    columns = torch.tensor(f0)[:, None].expand(3, count)
    found = film_reflectance(columns, torch.full((count,), ior), torch.full((count,), thickness), COSINES)
    expected = iridescent(np.array(f0)[:, None], ior, thickness, COSINES.double().numpy())
    np.testing.assert_allclose(found.numpy(), expected, atol=2e-3)
    assert np.ptp(found[:, -1].numpy()) > 1e-3


def test_a_film_of_no_thickness_or_of_air_leaves_the_reflectance_of_the_surface():
    """Up to the orders that the series leaves out, and away from grazing angles, where both interfaces reflect by Schlick's
    approximation."""
    steep = COSINES[COSINES > 0.8]
    columns = torch.tensor((0.04, 0.2, 0.6))[:, None].expand(3, len(steep))
    schlick = columns + (1.0 - columns) * (1.0 - steep) ** 5
    for ior, thickness in ((1.8, 0.0), (1.0, 300.0)):
        found = film_reflectance(columns, torch.full_like(steep, ior), torch.full_like(steep, thickness), steep)
        torch.testing.assert_close(found, schlick, atol=2e-2, rtol=0.0)


def test_fringes_of_thick_films_fade_to_the_sum_of_all_reflections():
    """Colours fade with the thickness, and two interfaces reflect R₁ + T₁² R₂ / (1 - R₁ R₂)."""
    columns = torch.full((3, 1), 0.2)
    found = film_reflectance(columns, torch.tensor([1.5]), torch.tensor([20_000.0]), torch.tensor([1.0]))
    base = (1.0 + math.sqrt(0.2001)) / (1.0 - math.sqrt(0.2001))
    first, second = 0.2**2, ((base - 1.5) / (base + 1.5)) ** 2
    expected = first + (1.0 - first) ** 2 * second / (1.0 - first * second)
    torch.testing.assert_close(found, torch.full((3, 1), expected), atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_the_opaque_value_has_the_films_reflectance(metallic):
    """Over black, the coat is alone; of a metal, all light is reflected."""
    incoming = GRID.directions[:, ::97]
    incoming = incoming[:, incoming[2] > 0.05]
    base = (0.9, 0.6, 0.3) if metallic else (0.0, 0.0, 0.0)
    parameters = film(1.8, 500.0, roughness=0.5, metallic=metallic, base_color=base, single_scattering=1.0)
    value, _ = OpaqueBSDF(tilted(40.0, incoming.shape[1]), surface(incoming.shape[1], **parameters)).evaluate(incoming)
    outgoing, light = tilted(40.0, incoming.shape[1]).double().numpy(), incoming.double().numpy()
    half = (outgoing + light) / np.linalg.norm(outgoing + light, axis=0)
    f0 = np.array(base)[:, None] if metallic else np.full((3, 1), 0.04)
    expected = iridescent(f0, 1.8, 500.0, (outgoing * half).sum(0)) * mirrors(outgoing, light, 0.25) * light[2]
    np.testing.assert_allclose(value.numpy(), expected, rtol=2e-2, atol=2e-4)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 75.0, 86.0])
@pytest.mark.parametrize("ior, thickness", FILMS)
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_white_furnaces_create_nothing(metallic, ior, thickness, degrees):
    for roughness in (0.2, 0.5):
        parameters = film(ior, thickness, base_color=WHITE, metallic=metallic, roughness=roughness)
        bsdf = OpaqueBSDF(tilted(degrees, DRAWS), surface(DRAWS, **parameters))
        value, pdf = bsdf.evaluate(bsdf.sample(uniforms(DRAWS, seed=3)))
        weights = (value / pdf.clamp(min=1e-20)).double().numpy()
        error = 4.0 * weights.std(axis=1) / math.sqrt(DRAWS)
        assert (weights.mean(axis=1) < 1.003 + error).all() and weights.mean() > 0.35


@pytest.mark.parametrize("front, thin", [(1.0, 0.0), (0.0, 0.0), (1.0, 1.0)])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_smooth_glass_with_a_film_splits_all_light(degrees, front, thin):
    """White light is reflected or transmitted, channel by channel; the latter in power, radiance times η²."""
    parameters = film(1.9, 350.0, base_color=WHITE, roughness=0.0, transmission=1.0, front=front, thin=thin)
    glass = DielectricBSDF(tilted(degrees, DRAWS), surface(DRAWS, **parameters))
    incoming, weight, _ = glass.sample(uniforms(DRAWS))
    eta = 1.0 if thin else 1.5 if front else 1.0 / 1.5
    power = torch.where(incoming[2] < 0.0, eta**2, 1.0) * weight
    mean, error = power.double().mean(1).numpy(), power.double().std(1).numpy() / math.sqrt(DRAWS)
    assert z_test(mean - 1.0, error + 1e-5) > SIGNIFICANCE
    reflected = (weight * (incoming[2] > 0.0)).double().mean(1).numpy()
    assert np.ptp(reflected) > 0.02 or degrees == 60.0


def test_reflection_from_inside_is_that_from_outside_at_the_refracted_angle():
    count, angle = 1000, math.radians(25.0)
    shares = []
    for front, degrees in ((0.0, 25.0), (1.0, math.degrees(math.asin(1.5 * math.sin(angle))))):
        parameters = film(1.9, 350.0, base_color=WHITE, roughness=0.0, transmission=1.0, front=front)
        glass = DielectricBSDF(tilted(degrees, count), surface(count, **parameters))
        incoming, weight, _ = glass.sample(uniforms(count))
        chance = (incoming[2] > 0.0).double().mean()
        shares.append(weight[:, incoming[2] > 0.0].double().mean(1) * chance)
    torch.testing.assert_close(*shares, rtol=0.0, atol=0.03)


@pytest.mark.parametrize("front, thin", [(1.0, 0.0), (0.0, 0.0), (1.0, 1.0)])
def test_draws_of_rough_glass_average_to_its_integral(front, thin):
    parameters = film(1.9, 350.0, roughness=0.6, transmission=1.0, front=front, thin=thin)
    value, _ = DielectricBSDF(tilted(40.0, POINTS), surface(POINTS, **parameters)).evaluate(GRID.directions)
    expected = GRID.integral(value)
    _, weight, _ = DielectricBSDF(tilted(40.0, DRAWS), surface(DRAWS, **parameters)).sample(uniforms(DRAWS))
    weights = weight.double().numpy()
    error = weights.std(axis=1) / math.sqrt(DRAWS) + 2e-3 * expected  # the quadrature's own
    assert z_test(weights.mean(axis=1) - expected, error) > SIGNIFICANCE


def test_channels_have_the_indices_of_the_extension_and_keep_their_mean():
    count = 30_000
    uniform = (torch.arange(count) + 0.5) / count
    for throughput in ((1.0, 1.0, 1.0), (0.2, 0.7, 0.1)):
        solid = surface(count, ior=1.5, dispersion=1.0)
        factor = disperse(solid, torch.tensor(throughput)[:, None].expand(3, count), uniform)
        torch.testing.assert_close(factor.mean(1), torch.ones(3), atol=1e-3, rtol=0.0)
        for channel, ior in enumerate((1.4875, 1.5, 1.5125)):
            chosen = factor[channel] > 0.0
            torch.testing.assert_close(solid.ior[chosen], torch.full_like(solid.ior[chosen], ior))
    kept = disperse(surface(count, dispersion=1.0), torch.tensor([0.0, 0.5, 0.0])[:, None].expand(3, count), uniform)
    torch.testing.assert_close(kept[1], torch.ones(count)), "a path stays in its channel"
    for plain in ({"dispersion": 0.0}, {"dispersion": 1.0, "thin": 1.0}):
        solid = surface(count, **plain)
        assert (disperse(solid, torch.ones(3, count), uniform) == 1.0).all() and (solid.ior == 1.5).all()


@pytest.mark.parametrize("roughness", [0.0, 0.4])
def test_a_dispersive_ball_shows_each_channel_as_glass_of_its_index(roughness):
    """Against three balls without dispersion, under a sky that refraction moves."""
    u, v = np.meshgrid(np.linspace(0.0, 1.0, 64), np.linspace(0.0, 1.0, 32))
    sky = np.stack((1.0 + np.sin(40.0 * u), 1.0 + np.cos(25.0 * v), 1.0 + np.sin(30.0 * u + 20.0 * v)), axis=-1)
    environment = Environment(sky.astype(np.float32))
    gem = Material("gem", (0.9, 1.0, 0.9), roughness=roughness, transmission=1.0, ior=1.6, dispersion=8.0)
    spread = 0.6 * 0.025 * 8.0

    def seen(material: Material, seed: int) -> np.ndarray:
        return estimates(
            scene([sphere(0)], [material], environment, max_depth=6), (0.5, 0.3, 4.0), (0.0, 0.0, -1.0), 60_000, seed
        )

    found = seen(gem, 0)
    assert (found.max(axis=0) > 0.0).mean() > 0.8, "paths stay in their channel"
    plain = [seen(replace(gem, ior=1.6 + spread * sign, dispersion=0.0), 1)[channel] for channel, sign in enumerate((-1, 0, 1))]
    difference = found.mean(axis=1) - [channel.mean() for channel in plain]
    variance = found.var(axis=1) + [channel.var() for channel in plain]
    assert z_test(difference, np.sqrt(variance / found.shape[1])) > SIGNIFICANCE
    same = seen(replace(gem, dispersion=0.0), 2)
    shift = np.abs(found.mean(axis=1) - same.mean(axis=1)) / np.sqrt(variance / found.shape[1])
    assert shift[[0, 2]].max() > 8.0
