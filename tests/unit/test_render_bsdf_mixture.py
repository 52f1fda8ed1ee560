"""Opaque and transmissive parts joined, in world space, under shading normals that differ from the geometry."""

import math

import numpy as np
import pytest
import torch

from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import dot, tangent_frame
from tests.support.sphere import SphereGrid, surface
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test

GRID = SphereGrid(32, 64, 8)
POINTS = GRID.directions.shape[1]
DRAWS = 200_000
NORMAL = (0.48, -0.6, 0.64)
VIEW = (0.6, 0.0, 0.8)


def vectors(value, count: int) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float32)[:, None].expand(3, count)


def scattering(count: int, choice: float | torch.Tensor | None, **parameters) -> Scattering:
    """Surfaces with a tilted normal; `choice` may be one number for all."""
    parameters = {"normal": NORMAL, "geometric_normal": NORMAL} | parameters
    chosen = torch.full((count,), choice) if isinstance(choice, float) else choice
    return Scattering(surface(count, outgoing=vectors(VIEW, count), **parameters), chosen)


def uniforms(count: int, seed: int = 0) -> torch.Tensor:
    return PixelRandom(seed, 0, torch.arange(count)).uniform(0, 4)


def test_tangent_frames_are_orthonormal_and_right_handed():
    special = torch.tensor([[0.0, 0.0, 1e-4, 1.0, 1.0], [0.0, 0.0, -1e-4, 0.0, 0.0], [1.0, -1.0, -1.0, 0.0, -0.0]])
    normals = torch.cat((GRID.directions[:, ::37], special), dim=1)
    tangent, bitangent = tangent_frame(normals)
    for a, b in ((tangent, bitangent), (tangent, normals), (bitangent, normals)):
        assert dot(a, b).abs().max() < 1e-5
    assert (tangent.norm(dim=0) - 1.0).abs().max() < 1e-5
    torch.testing.assert_close(torch.linalg.cross(tangent, bitangent, dim=0), normals, atol=1e-5, rtol=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("choice", [0.1, 0.9])  # glass below 0.6, opaque above
def test_draws_follow_the_density(choice):
    parameters = {"roughness": 0.6, "transmission": 0.6}
    drawn, weight, _ = scattering(DRAWS, choice, **parameters).sample(uniforms(DRAWS))
    _, pdf = scattering(POINTS, choice, **parameters).evaluate(GRID.directions)
    kept = (weight > 0.0).any(0)
    # The tilted horizon crosses cells, where the quadrature is coarse: they and the lost draws are one cell.
    side = GRID.cell_integrals(dot(GRID.directions, vectors(NORMAL, POINTS)).sign())
    crossed = np.abs(side) < 0.999 * GRID.cell_integrals(torch.ones(POINTS))
    counts, expected = GRID.histogram(drawn[:, kept])[~crossed], GRID.cell_integrals(pdf)[~crossed]
    counts, expected = np.append(counts, DRAWS - counts.sum()), np.append(expected, 1.0 - expected.sum())
    assert chi_square(counts, expected) > SIGNIFICANCE


def test_the_choice_mixes_glass_in_proportion_to_transmission():
    """The mean over choices of value and weights is (1 - t) opaque + t glass, with t = transmission (1 - metallic)."""
    parameters = {"roughness": 0.6, "transmission": 0.6, "metallic": 0.25}
    opaque, _ = scattering(POINTS, 0.99, **parameters).evaluate(GRID.directions)
    glass, _ = scattering(POINTS, 0.01, **parameters).evaluate(GRID.directions)
    share = 0.6 * 0.75
    expected = (1.0 - share) * GRID.integral(opaque) + share * GRID.integral(glass)
    _, weight, _ = scattering(DRAWS, uniforms(DRAWS)[3], **parameters).sample(uniforms(DRAWS))
    weights = weight.double().numpy()
    error = weights.std(axis=1) / math.sqrt(DRAWS) + 2e-3 * expected  # the quadrature's own at the horizon
    assert z_test(weights.mean(axis=1) - expected, error) > SIGNIFICANCE


@pytest.mark.parametrize("choice", [None, 0.99, 0.01])
def test_weights_and_densities_of_draws_are_those_of_evaluate(choice):
    parameters = {"roughness": 0.6, "transmission": 0.6}
    joined = scattering(DRAWS, choice, **parameters)
    drawn, weight, pdf = joined.sample(uniforms(DRAWS))
    value, density = joined.evaluate(drawn)
    clear = (weight > 0.0).any(0) & (dot(drawn, vectors(NORMAL, DRAWS)).abs() > 1e-3)
    torch.testing.assert_close(density[clear], pdf[clear], rtol=2e-2, atol=1e-4)
    torch.testing.assert_close((value / density)[:, clear], weight[:, clear], rtol=2e-2, atol=1e-3)


@pytest.mark.parametrize("choice", [None, 0.01])
def test_nothing_passes_where_the_two_normals_disagree(choice):
    """Opaque light stays on the viewer's side of the geometry; refracted light crosses it."""
    geometric = (0.0, 0.0, 1.0)
    parameters = {"roughness": 0.6, "transmission": 1.0, "geometric_normal": geometric}
    value, _ = scattering(POINTS, choice, **parameters).evaluate(GRID.directions)
    above = dot(GRID.directions, vectors(NORMAL, POINTS)) > 0.0
    outside = GRID.directions[2] > 0.0
    assert not value[:, above != outside].any()
    assert value[:, above & outside].any()
    assert bool(value[:, ~above & ~outside].any()) == (choice is not None)
    drawn, weight, _ = scattering(DRAWS, choice, **parameters).sample(uniforms(DRAWS))
    above = dot(drawn, vectors(NORMAL, DRAWS)) > 0.0
    clear = dot(drawn, vectors(NORMAL, DRAWS)).abs() > 1e-4
    assert not weight[:, (above != (drawn[2] > 0.0)) & clear].any()
    assert (weight > 0.0).any()
