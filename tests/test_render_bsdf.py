"""Opaque surfaces: the BRDF against its textbook form, its sampling, and its energy."""

import math

import numpy as np
import pytest
import torch

from bokehguide.render.bsdf import OpaqueBSDF, ggx_density, sample_visible_normal
from bokehguide.render.random import PixelRandom
from tests.sphere import SphereGrid, surface, tilted
from tests.statistical import SIGNIFICANCE, chi_square, z_test

GRID = SphereGrid()
POINTS = GRID.directions.shape[1]
DRAWS = 200_000

# Roughness, metallic, specular, degrees from the normal.
CASES = [
    (0.25, 0.0, 1.0, 0.0),
    (0.25, 1.0, 1.0, 30.0),
    (0.25, 0.5, 1.0, 75.0),
    (0.5, 0.0, 1.0, 45.0),
    (0.5, 1.0, 1.0, 0.0),
    (0.5, 1.0, 1.0, 80.0),
    (0.5, 0.3, 0.5, 60.0),
    (1.0, 0.0, 1.0, 85.0),
    (1.0, 1.0, 1.0, 50.0),
    (1.0, 0.0, 0.0, 50.0),
]


def brdf(outgoing, incoming, base_color, metallic, roughness, specular, ior) -> np.ndarray:
    """glTF 2.0 appendix B with KHR_materials_specular and _ior, in float64: `[3, N]` directions, `[3, N]` values.

    The base lies under a coat that light passes twice.
    """
    a2 = roughness**4
    half = outgoing + incoming
    half /= np.linalg.norm(half, axis=0)
    tangent2 = (half[0] ** 2 + half[1] ** 2) / half[2] ** 2
    distribution = a2 / (np.pi * half[2] ** 4 * (a2 + tangent2) ** 2)
    lambdas = [0.5 * (np.sqrt(1.0 + a2 * (1.0 / w[2] ** 2 - 1.0)) - 1.0) for w in (outgoing, incoming)]
    microfacet = distribution / (1.0 + lambdas[0] + lambdas[1]) / (4.0 * outgoing[2] * incoming[2])
    schlick = (1.0 - (outgoing * half).sum(0)) ** 5
    f0 = specular * ((ior - 1.0) / (ior + 1.0)) ** 2
    coat = f0 + (specular - f0) * schlick
    base = np.asarray(base_color)[:, None]
    spread = 0.06 + 0.934 / (1.0 + (roughness**2 / 0.27) ** 3)
    stopped = [f0 + (specular - f0) * (0.006 + spread * (1.0 - w[2]) ** 5) for w in (outgoing, incoming)]
    entering = 1.0 - f0 - (specular - f0) * (0.006 + spread / 21.0)
    under = (1.0 - stopped[0]) * (1.0 - stopped[1]) / entering
    dielectric = under * base / np.pi + coat * microfacet
    metal = (base + (1.0 - base) * schlick) * microfacet
    return (1.0 - metallic) * dielectric + metallic * metal


def uniforms(count: int, seed: int = 0) -> torch.Tensor:
    return PixelRandom(seed, 0, torch.arange(count)).uniform(0, 3)


def case_bsdf(case, count: int, base_color=(0.8, 0.5, 0.3)) -> OpaqueBSDF:
    roughness, metallic, specular, degrees = case
    return OpaqueBSDF(tilted(degrees, count), surface(count, base_color, metallic, roughness, specular))


@pytest.mark.parametrize("case", CASES)
def test_the_value_is_the_textbooks(case):
    roughness, metallic, specular, degrees = case
    incoming = GRID.directions[:, :: 97][:, ::2]
    incoming = incoming[:, incoming[2] > 0.02]
    value, _ = case_bsdf(case, incoming.shape[1]).evaluate(incoming)
    outgoing = tilted(degrees, incoming.shape[1]).double().numpy()
    light = incoming.double().numpy()
    expected = brdf(outgoing, light, (0.8, 0.5, 0.3), metallic, roughness, specular, 1.5) * light[2]
    np.testing.assert_allclose(value.numpy(), expected, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_draws_follow_the_density_which_misses_only_the_share_below_the_horizon(case):
    drawn = case_bsdf(case, DRAWS).sample(uniforms(DRAWS))
    assert torch.allclose(drawn.norm(dim=0), torch.ones(()), atol=1e-5)
    _, pdf = case_bsdf(case, POINTS).evaluate(GRID.directions)
    assert (pdf[GRID.directions[2] < 0.0] == 0.0).all()
    assert (pdf[GRID.directions[2] > 0.0] > 0.0).all()
    above = drawn[:, drawn[2] > 0.0]
    cells = GRID.cell_integrals(pdf)
    below = 1.0 - cells.sum()
    assert -1e-3 < below < 0.5
    counts = np.append(GRID.histogram(above), DRAWS - above.shape[1])
    expected = np.append(cells, max(below, 0.0) + 1e-6)
    assert chi_square(counts, expected / expected.sum()) > SIGNIFICANCE


@pytest.mark.parametrize("roughness, degrees", [(0.5, 30.0), (0.5, 80.0), (1.0, 50.0)])
def test_the_share_below_the_horizon_is_that_of_the_visible_normals_that_reflect_there(roughness, degrees):
    outgoing, half = tilted(degrees, POINTS).double().numpy(), GRID.directions.double().numpy()
    a2, cosine = roughness**4, np.maximum((outgoing * half).sum(0), 0.0)
    distribution = a2 / (np.pi * (half[0] ** 2 + half[1] ** 2 + a2 * half[2] ** 2) ** 2) * (half[2] > 0.0)
    masking = 2.0 / (1.0 + np.sqrt(1.0 + a2 * (1.0 / outgoing[2] ** 2 - 1.0)))
    visible = masking * distribution * cosine / outgoing[2]
    assert float(visible @ GRID.solid_angle) == pytest.approx(1.0, abs=2e-3)
    below = 2.0 * cosine * half[2] < outgoing[2]
    expected = float((visible * below) @ GRID.solid_angle)
    drawn = case_bsdf((roughness, 1.0, 1.0, degrees), DRAWS).sample(uniforms(DRAWS, seed=3))
    error = math.sqrt(expected * (1.0 - expected) / DRAWS) + 1e-3  # the quadrature's own
    assert z_test(float((drawn[2] <= 0.0).double().mean()) - expected, error) > SIGNIFICANCE


@pytest.mark.parametrize("case", CASES)
def test_the_mean_weight_of_draws_is_the_albedo_by_quadrature(case):
    grid_value, _ = case_bsdf(case, POINTS).evaluate(GRID.directions)
    albedo = GRID.integral(grid_value)
    bsdf = case_bsdf(case, DRAWS)
    value, pdf = bsdf.evaluate(bsdf.sample(uniforms(DRAWS, seed=1)))
    weights = (value / pdf.clamp(min=1e-20)).double().numpy()
    error = weights.std(axis=1) / math.sqrt(DRAWS) + 5e-4 * albedo  # the quadrature's own
    assert z_test(weights.mean(axis=1) - albedo, error) > SIGNIFICANCE


@pytest.mark.parametrize("roughness", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("degrees", [0.0, 40.0, 70.0, 82.0])
def test_a_white_metal_and_a_coat_over_black_reflect_no_more_than_arrives(roughness, degrees):
    for metallic, base_color in ((1.0, (1.0, 1.0, 1.0)), (0.0, (0.0, 0.0, 0.0))):
        value, _ = case_bsdf((roughness, metallic, 1.0, degrees), POINTS, base_color).evaluate(GRID.directions)
        albedo = GRID.integral(value).max()
        assert 0.01 < albedo < 1.002


@pytest.mark.parametrize("roughness", [0.2, 0.3, 0.4, 0.5, 0.7, 1.0])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 55.0, 65.0, 75.0, 82.0, 87.0])
def test_a_coat_over_white_reflects_no_more_than_arrives_and_all_of_it_head_on(roughness, degrees):
    value, _ = case_bsdf((roughness, 0.0, 1.0, degrees), POINTS, (1.0, 1.0, 1.0)).evaluate(GRID.directions)
    albedo = GRID.integral(value).max()
    assert albedo < 1.0005  # the quadrature's own error
    if degrees <= 45.0:
        assert albedo > 0.96


def test_the_roughest_white_metal_seen_from_above_reflects_one_minus_ln_2():
    """At α = 1 the integrand of single scattering is cos / (1 + cos)."""
    value, _ = case_bsdf((1.0, 1.0, 1.0, 0.0), POINTS, (1.0, 1.0, 1.0)).evaluate(GRID.directions)
    assert GRID.integral(value)[0] == pytest.approx(1.0 - math.log(2.0), rel=1e-3)


@pytest.mark.parametrize("degrees", [0.0, 50.0, 80.0])
def test_without_specular_the_albedo_is_the_base_colour(degrees):
    value, _ = case_bsdf((0.3, 0.0, 0.0, degrees), POINTS).evaluate(GRID.directions)
    np.testing.assert_allclose(GRID.integral(value), [0.8, 0.5, 0.3], rtol=1e-4)
    bsdf = case_bsdf((0.3, 0.0, 0.0, degrees), 1000)
    value, pdf = bsdf.evaluate(bsdf.sample(uniforms(1000)))
    torch.testing.assert_close(value / pdf, torch.tensor([0.8, 0.5, 0.3])[:, None].expand(3, 1000), rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("case", CASES)
def test_reciprocity(case):
    roughness, metallic, specular, degrees = case
    incoming = GRID.directions[:, ::101]
    incoming = incoming[:, incoming[2] > 0.02]
    count = incoming.shape[1]
    there, _ = case_bsdf(case, count).evaluate(incoming)
    parameters = surface(count, (0.8, 0.5, 0.3), metallic, roughness, specular)
    outgoing = tilted(degrees, count)
    back, _ = OpaqueBSDF(incoming, parameters).evaluate(outgoing)
    torch.testing.assert_close(there / incoming[2], back / outgoing[2], rtol=2e-3, atol=1e-6)


def half_vectors(count: int) -> tuple[torch.Tensor, np.ndarray]:
    """Midpoints over the upper hemisphere that crowd around the pole, `[3, N]`, and their solid angles."""
    edge = (np.linspace(0.0, 1.0, count + 1) ** 4) * np.pi / 2.0
    theta = 0.5 * (edge[:-1] + edge[1:])
    phi = (np.arange(count) + 0.5) * 2.0 * np.pi / count
    solid_angle = np.repeat((np.cos(edge[:-1]) - np.cos(edge[1:])) * 2.0 * np.pi / count, count)
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    points = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)))
    return torch.from_numpy(points.reshape(3, -1).astype(np.float32)), solid_angle


@pytest.mark.parametrize("alpha", [1e-3, 0.01, 0.1, 0.5, 1.0])
def test_the_projected_area_of_the_microfacets_is_that_of_the_surface(alpha):
    half, solid_angle = half_vectors(800)
    density = ggx_density(half, torch.full_like(half[0], alpha)) * half[2]
    assert float(density.double().numpy() @ solid_angle) == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("roughness", [0.0, 0.1])
@pytest.mark.parametrize("degrees", [0.0, 60.0])
def test_near_mirrors_in_half_vector_space(roughness, degrees):
    """Lobes too narrow for the sphere's grid: the density integrates to 1, the white metal to almost 1."""
    half, solid_angle = half_vectors(800)
    count = half.shape[1]
    outgoing = tilted(degrees, count)
    cosine = (outgoing * half).sum(0)
    incoming = 2.0 * cosine * half - outgoing
    incoming /= incoming.norm(dim=0)
    value, pdf = OpaqueBSDF(outgoing, surface(count, (1.0, 1.0, 1.0), 1.0, roughness)).evaluate(incoming)
    jacobian = 4.0 * cosine.clamp(min=0.0).double().numpy() * solid_angle
    assert float(pdf.double().numpy() @ jacobian) == pytest.approx(1.0, abs=5e-3)
    assert 0.99 < float(value[0].double().numpy() @ jacobian) < 1.003


def test_the_smoothest_surface_reflects_like_a_mirror():
    bsdf = OpaqueBSDF(tilted(40.0, 1000), surface(1000, (1.0, 1.0, 1.0), 1.0, 0.0))
    mirrored = tilted(40.0, 1000) * torch.tensor([-1.0, -1.0, 1.0])[:, None]
    drawn = bsdf.sample(uniforms(1000))
    assert ((drawn - mirrored).norm(dim=0).median() < 5e-3)
    value, pdf = bsdf.evaluate(drawn)
    assert torch.allclose(value / pdf, torch.ones(()), atol=1e-3)


@pytest.mark.parametrize("degrees", [0.0, 60.0, 89.5])
def test_visible_normals_point_up_and_towards_the_viewer(degrees):
    outgoing = tilted(degrees, 100_000)
    half = sample_visible_normal(outgoing, torch.full((100_000,), 0.3), uniforms(100_000)[:2])
    assert (half[2] > 0.0).all()
    assert ((outgoing * half).sum(0) > -1e-4).all()


def test_extreme_directions_and_parameters_give_finite_numbers():
    degrees = [0.0, 89.0, 89.99, 90.0]
    for roughness in (0.0, 0.05, 1.0):
        for metallic in (0.0, 1.0):
            for angle in degrees:
                bsdf = OpaqueBSDF(tilted(angle, 20_000), surface(20_000, (0.0, 1.0, 1.0), metallic, roughness))
                drawn = bsdf.sample(uniforms(20_000, seed=2))
                value, pdf = bsdf.evaluate(drawn)
                assert drawn.isfinite().all() and value.isfinite().all() and pdf.isfinite().all()
                assert (value >= 0.0).all() and (pdf >= 0.0).all()
                assert (value / pdf.clamp(min=1e-20)).max() < 3.0
