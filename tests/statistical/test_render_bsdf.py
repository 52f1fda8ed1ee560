"""Opaque surfaces: the BRDF against its textbook form, its sampling, and its energy."""

import math

import numpy as np
import pytest
import torch

from bokehguide.render.bsdf.microfacets import ggx_density, sample_visible_normal
from bokehguide.render.bsdf.opaque import OpaqueBSDF
from bokehguide.render.random import PixelRandom
from bokehguide.render.surface import MIN_ALPHA
from tests.support.scattering_formulas import brdf
from tests.support.sphere import SphereGrid, squeezed, surface, tilted, unsqueezed
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test

GRID = SphereGrid()
POINTS = GRID.directions.shape[1]
DRAWS = 200_000

COLOR = (0.8, 0.5, 0.3)

# Degrees from the normal, and what differs from a rough coat over COLOR.
CASES = [
    (0.0, {"roughness": 0.25}),
    (30.0, {"roughness": 0.25, "metallic": 1.0}),
    (75.0, {"roughness": 0.25, "metallic": 0.5}),
    (45.0, {"roughness": 0.5}),
    (0.0, {"roughness": 0.5, "metallic": 1.0}),
    (80.0, {"roughness": 0.5, "metallic": 1.0}),
    (60.0, {"roughness": 0.5, "metallic": 0.3, "specular": 0.5}),
    (85.0, {"roughness": 1.0}),
    (50.0, {"roughness": 1.0, "metallic": 1.0}),
    (50.0, {"roughness": 1.0, "specular": 0.0}),
    (30.0, {"roughness": 0.4, "specular_color": (0.2, 1.0, 4.0), "ior": 1.8}),
    (70.0, {"roughness": 0.6, "specular": 0.8, "specular_color": (30.0, 1.0, 0.0)}),
    (20.0, {"roughness": 0.8, "clearcoat": 1.0, "clearcoat_roughness": 0.3}),
    (65.0, {"roughness": 0.4, "metallic": 1.0, "clearcoat": 0.7, "clearcoat_roughness": 0.7}),
    (80.0, {"roughness": 0.5, "specular_color": (1.0, 0.5, 0.1), "clearcoat": 0.3, "clearcoat_roughness": 0.3}),
]
SINGLE = {"single_scattering": 1.0}
NARROW = [0.0, 0.05, 0.1, 0.2, 0.4]


def uniforms(count: int, seed: int = 0) -> torch.Tensor:
    return PixelRandom(seed, 0, torch.arange(count)).uniform(0, 3)


def case_bsdf(case, count: int) -> OpaqueBSDF:
    degrees, parameters = case
    return OpaqueBSDF(tilted(degrees, count), surface(count, **parameters))


@pytest.mark.parametrize("case", CASES)
def test_the_value_is_the_textbooks(case):
    degrees, parameters = case
    incoming = GRID.directions[:, ::97][:, ::2]
    incoming = incoming[:, incoming[2] > 0.02]
    value, _ = case_bsdf(case, incoming.shape[1]).evaluate(incoming)
    outgoing = tilted(degrees, incoming.shape[1]).double().numpy()
    light = incoming.double().numpy()
    expected = brdf(outgoing, light, **parameters) * light[2]
    np.testing.assert_allclose(value.numpy(), expected, rtol=2e-3, atol=1e-4)


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
    drawn = case_bsdf((degrees, {"roughness": roughness, "metallic": 1.0}), DRAWS).sample(uniforms(DRAWS, seed=3))
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


ROUGHEST = {"roughness": 1.0, "metallic": 1.0, "base_color": (1.0, 1.0, 1.0)}


def test_the_roughest_white_metal_seen_from_above_reflects_one_minus_ln_2():
    """At α = 1 the integrand of single scattering is cos / (1 + cos)."""
    value, _ = case_bsdf((0.0, ROUGHEST | {"single_scattering": 1.0}), POINTS).evaluate(GRID.directions)
    assert GRID.integral(value)[0] == pytest.approx(1.0 - math.log(2.0), rel=1e-3)


@pytest.mark.parametrize("degrees", [0.0, 50.0, 80.0])
def test_without_specular_the_albedo_is_the_base_colour(degrees):
    value, _ = case_bsdf((degrees, {"specular": 0.0}), POINTS).evaluate(GRID.directions)
    np.testing.assert_allclose(GRID.integral(value), [0.8, 0.5, 0.3], rtol=1e-4)
    bsdf = case_bsdf((degrees, {"specular": 0.0}), 1000)
    value, pdf = bsdf.evaluate(bsdf.sample(uniforms(1000)))
    torch.testing.assert_close(value / pdf, torch.tensor([0.8, 0.5, 0.3])[:, None].expand(3, 1000), rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("case", CASES)
def test_reciprocity_without_multiple_scattering(case):
    degrees, parameters = case[0], case[1] | SINGLE
    incoming = GRID.directions[:, ::101]
    incoming = incoming[:, incoming[2] > 0.02]
    count = incoming.shape[1]
    there, _ = case_bsdf((degrees, parameters), count).evaluate(incoming)
    outgoing = tilted(degrees, count)
    back, _ = OpaqueBSDF(incoming, surface(count, **parameters)).evaluate(outgoing)
    torch.testing.assert_close(there / incoming[2], back / outgoing[2], rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("alpha", [1e-3, 0.01, 0.1, 0.5, 1.0])
def test_the_projected_area_of_the_microfacets_is_that_of_the_surface(alpha):
    half, jacobian = squeezed(GRID.directions.double().numpy(), alpha)
    half = torch.from_numpy(half).float()
    area = ggx_density(half, torch.full_like(half[0], alpha)) * half[2].clamp(min=0.0) * torch.from_numpy(jacobian)
    assert GRID.integral(area) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("roughness", NARROW)
@pytest.mark.parametrize("degrees", [0.0, 40.0, 70.0, 85.0])
@pytest.mark.parametrize("layer", ["metal", "clearcoat"])
def test_draws_of_lobes_too_narrow_for_the_sphere_follow_the_density_of_their_half_vectors(layer, degrees, roughness):
    """Half vectors in coordinates in which every lobe is as wide as the roughest."""
    if layer == "metal":
        case = (degrees, {"metallic": 1.0, "roughness": roughness})
    else:  # over black, so that nothing else is sampled
        case = (degrees, {"base_color": (0.0, 0.0, 0.0), "specular": 0.0, "clearcoat": 1.0, "clearcoat_roughness": roughness})
    alpha, outgoing = max(roughness**2, MIN_ALPHA), tilted(degrees, 1).double().numpy()
    half, jacobian = squeezed(GRID.directions.double().numpy(), alpha)
    cosine = (outgoing * half).sum(0)
    _, pdf = case_bsdf(case, POINTS).evaluate(torch.from_numpy(2.0 * cosine * half - outgoing).float())
    visible = (half[2] > 0.0) & (cosine > 0.0)
    cells = GRID.cell_integrals(torch.from_numpy(np.where(visible, pdf.numpy() * 4.0 * cosine * jacobian, 0.0)))
    drawn = case_bsdf(case, DRAWS).sample(uniforms(DRAWS, seed=4)).double().numpy()
    above = drawn[2] > 0.0
    counts = GRID.histogram(torch.from_numpy(unsqueezed(drawn[:, above] + outgoing, alpha)))
    below = 1.0 - cells.sum()
    assert -2e-3 < below < 0.5
    counts, expected = np.append(counts, (~above).sum()), np.append(cells, max(below, 1e-4))
    assert chi_square(counts, expected / expected.sum()) > SIGNIFICANCE


def test_the_smoothest_surface_reflects_like_a_mirror():
    bsdf = OpaqueBSDF(tilted(40.0, 1000), surface(1000, (1.0, 1.0, 1.0), 1.0, 0.0))
    mirrored = tilted(40.0, 1000) * torch.tensor([-1.0, -1.0, 1.0])[:, None]
    drawn = bsdf.sample(uniforms(1000))
    assert (drawn - mirrored).norm(dim=0).median() < 5e-3
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
                assert (value / pdf.clamp(min=1e-20)).max() < 3.4
