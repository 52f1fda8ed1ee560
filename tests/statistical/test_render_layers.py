"""Sheen, anisotropy and diffuse transmission: values against the extensions' formulas, sampling, energy."""

import math

import numpy as np
import pytest
import torch

from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.bsdf.opaque import OpaqueBSDF
from bokehguide.render.bsdf.sheen import MIN_ROUGHNESS, albedo_table, sheen_albedo
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import aligned_frame, dot
from tests.support.scattering_formulas import brdf, sheen_albedos
from tests.support.sphere import SphereGrid, surface, tilted
from tests.support.statistical import SIGNIFICANCE, chi_square

GRID = SphereGrid()
POINTS = GRID.directions.shape[1]
DRAWS = 200_000
WHITE = (1.0, 1.0, 1.0)
CLOTH = {"sheen_color": (0.9, 0.6, 0.3)}
LEAF = {"diffuse_transmission": 0.7, "transmission_color": (0.8, 0.9, 0.2)}
COAT = {"clearcoat": 0.7, "clearcoat_roughness": 0.4}

# Degrees from the normal, and the material.
CASES = [
    (0.0, CLOTH | {"sheen_roughness": 0.3, "roughness": 0.8}),
    (70.0, CLOTH | {"sheen_roughness": 0.5, "roughness": 0.5, "metallic": 0.5}),
    (85.0, CLOTH | {"sheen_roughness": 0.2, "roughness": 0.6}),
    (40.0, CLOTH | COAT | {"sheen_roughness": 1.0, "roughness": 0.9}),
    (0.0, {"roughness": 0.5, "anisotropy": 0.6, "metallic": 1.0}),
    (60.0, {"roughness": 0.6, "anisotropy": 1.0, "metallic": 1.0}),
    (75.0, COAT | {"roughness": 0.7, "anisotropy": 0.5}),
    (20.0, LEAF | {"roughness": 0.4}),
    (65.0, LEAF | {"roughness": 0.6, "metallic": 0.3, "specular_color": (1.0, 0.5, 0.1)}),
    (50.0, LEAF | CLOTH | COAT | {"roughness": 0.7, "sheen_roughness": 0.6, "anisotropy": 0.7}),
]


def uniforms(count: int, seed: int = 0) -> torch.Tensor:
    return PixelRandom(seed, 0, torch.arange(count)).uniform(0, 3)


def bsdf(case, count: int, outgoing: torch.Tensor | None = None) -> OpaqueBSDF:
    degrees, parameters = case
    return OpaqueBSDF(tilted(degrees, count) if outgoing is None else outgoing, surface(count, **parameters))


@pytest.mark.parametrize("case", CASES)
def test_the_value_is_that_of_the_formulas(case):
    incoming = GRID.directions[:, ::97]
    incoming = incoming[:, incoming[2].abs() > 0.02]
    value, _ = bsdf(case, incoming.shape[1]).evaluate(incoming)
    light = incoming.double().numpy()
    expected = brdf(tilted(case[0], light.shape[1]).double().numpy(), light, **case[1]) * np.abs(light[2])
    excess = 0.025 if "anisotropy" in case[1] else 6e-3  # of albedos of anisotropic microfacets
    np.testing.assert_allclose(value.numpy(), expected, rtol=excess, atol=1e-5)
    assert ((value[:, incoming[2] < 0.0] > 0.0).any()) == ("diffuse_transmission" in case[1])


@pytest.mark.parametrize("case", CASES)
def test_draws_follow_the_density(case):
    drawn = bsdf(case, DRAWS).sample(uniforms(DRAWS))
    assert torch.allclose(drawn.norm(dim=0), torch.ones(()), atol=1e-5)
    _, pdf = bsdf(case, POINTS).evaluate(GRID.directions)
    _, density = bsdf(case, DRAWS).evaluate(drawn)
    cells = GRID.cell_integrals(pdf)
    lost = 1.0 - cells.sum()
    assert -2e-3 < lost < 0.5 and (abs(lost) < 2e-3 or "diffuse_transmission" not in case[1])
    counts = np.append(GRID.histogram(drawn[:, density > 0.0]), int((density <= 0.0).sum()))
    expected = np.append(cells, max(lost, 0.0) + 1e-6)
    assert chi_square(counts, expected / expected.sum()) > SIGNIFICANCE


@pytest.mark.parametrize("case", CASES)
def test_the_mean_weight_of_draws_is_the_albedo_by_quadrature(case):
    assert GRID.albedo_check(bsdf(case, POINTS), bsdf(case, DRAWS), uniforms(DRAWS, seed=1)) > SIGNIFICANCE


@pytest.mark.parametrize("case", CASES)
def test_reciprocity_without_multiple_scattering(case):
    case = (case[0], case[1] | {"single_scattering": 1.0})
    incoming = GRID.directions[:, ::101]
    incoming = incoming[:, incoming[2].abs() > 0.05]
    outgoing = tilted(case[0], incoming.shape[1])
    there = bsdf(case, incoming.shape[1]).evaluate(incoming)[0] / incoming[2].abs()
    # From below, the surface is seen from its other side.
    side = torch.sign(incoming[2]) * torch.tensor([0.0, 0.0, 1.0])[:, None] + torch.tensor([1.0, 1.0, 0.0])[:, None]
    back = bsdf(case, incoming.shape[1], incoming * side).evaluate(outgoing * side)[0] / outgoing[2]
    torch.testing.assert_close(there, back, rtol=3e-3, atol=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 75.0, 84.0, 88.0])
@pytest.mark.parametrize(
    "parameters",
    [
        *({"base_color": WHITE, "sheen_color": WHITE, "sheen_roughness": rough} for rough in (0.0, 0.1, 0.2, 0.3, 0.5, 1.0)),
        *({"base_color": WHITE, "roughness": rough, "anisotropy": 1.0} for rough in (0.1, 0.3, 0.6)),
        *({"base_color": WHITE, "roughness": rough, "anisotropy": 0.5, "metallic": 1.0} for rough in (0.2, 0.5)),
        {"base_color": WHITE, "diffuse_transmission": 0.6, "roughness": 0.2},
        {"base_color": WHITE, "sheen_color": WHITE, "sheen_roughness": 0.4, "diffuse_transmission": 0.5} | COAT,
    ],
)
def test_white_furnaces_create_nothing(parameters, degrees):
    drawn = bsdf((degrees, parameters), DRAWS)
    value, pdf = drawn.evaluate(drawn.sample(uniforms(DRAWS, seed=3)))
    weights = (value / pdf.clamp(min=1e-20)).double()
    assert weights.isfinite().all()
    mean, error = float(weights[0].mean()), float(weights[0].std()) / math.sqrt(DRAWS)
    assert 0.5 < mean < 1.003 + 4.0 * error


@pytest.mark.parametrize("roughness", [0.07, 0.1, 0.23, 0.5, 0.77, 1.0])
def test_the_table_of_sheens_holds_their_albedos(roughness):
    cosine = torch.linspace(0.0, 1.0, 500) ** 2
    found = sheen_albedo(albedo_table(), cosine, torch.full_like(cosine, roughness)).numpy()
    expected = sheen_albedos(cosine.double().numpy(), max(roughness, MIN_ROUGHNESS))
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=4e-3)


def test_diffuse_transmission_takes_from_the_reflection_what_it_gives():
    """Without a coat, the Lambertian lobes on both sides share the light by the factor."""
    parameters = {"specular": 0.0, "base_color": WHITE, "diffuse_transmission": 0.3, "transmission_color": (0.5, 1.0, 0.0)}
    value, _ = bsdf((40.0, parameters), POINTS).evaluate(GRID.directions)
    above = (GRID.directions[2] > 0.0).float()
    np.testing.assert_allclose(GRID.integral(value * above), 0.7, rtol=1e-3)
    np.testing.assert_allclose(GRID.integral(value * (1.0 - above)), [0.15, 0.3, 0.0], rtol=1e-3)


def test_highlights_are_longer_along_the_tangent():
    """Mirror images spread by the larger roughness in the plane of the tangent, wherever the tangent points."""
    tangent, normal = torch.tensor([0.0, 0.6, 0.8]), torch.tensor([0.0, -0.8, 0.6])
    count = 50_000
    outgoing = normal[:, None].expand(3, count)
    parameters = {"roughness": 0.4, "metallic": 1.0, "anisotropy": 0.8, "normal": tuple(normal.tolist())}
    brushed = surface(
        count, **parameters, geometric_normal=tuple(normal.tolist()), tangent=tuple(tangent.tolist()), outgoing=outgoing
    )
    drawn, _, _ = Scattering(brushed, None).sample(uniforms(count))
    along = dot(drawn, tangent[:, None].expand(3, count)).abs().median()
    across = drawn[0].abs().median()
    assert along > 2.0 * across


def test_an_unknown_tangent_gives_some_frame():
    normal = torch.nn.functional.normalize(torch.tensor([[0.3, 0.0], [-0.5, 0.0], [0.7, 1.0]]), dim=0)
    along = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, 2.0]])
    tangent, bitangent = aligned_frame(normal, along)
    frames = torch.stack((tangent, bitangent, normal)).permute(2, 0, 1)
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3).expand(2, 3, 3), atol=1e-5, rtol=0.0)
