"""Opaque and transmissive parts joined, in world space, under shading normals that differ from the geometry."""

import math

import numpy as np
import pytest
import torch

from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.geometry import Geometry
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import dot, tangent_frame
from bokehguide.scene.types import Material, Texture
from tests.support.sphere import SphereGrid, surface
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test
from tests.support.tracing import found, rectangle, scene

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
    """The mean over choices of value and weights is (1 - t) opaque + t glass."""
    parameters = {"roughness": 0.6, "transmission": 0.6, "metallic": 0.25}
    opaque, _ = scattering(POINTS, 0.99, **parameters).evaluate(GRID.directions)
    glass, _ = scattering(POINTS, 0.01, **parameters).evaluate(GRID.directions)
    expected = 0.4 * GRID.integral(opaque) + 0.6 * GRID.integral(glass)
    _, weight, _ = scattering(DRAWS, uniforms(DRAWS)[3], **parameters).sample(uniforms(DRAWS))
    weights = weight.double().numpy()
    error = weights.std(axis=1) / math.sqrt(DRAWS) + 2e-3 * expected  # the quadrature's own at the horizon
    assert z_test(weights.mean(axis=1) - expected, error) > SIGNIFICANCE


def mean_value(choices: np.ndarray, **parameters) -> torch.Tensor:
    """Mean over `choices` of BSDF times |cosine| of a plate of the material `parameters`, for the directions of `GRID`."""
    geometry = Geometry(scene([rectangle(0)], [Material("plate", (0.9, 0.6, 0.3), roughness=0.6, **parameters)]))
    start, end = np.tile([[1.0, 0.2, 2.0]], (POINTS, 1)), np.array([[0.3, 0.1, 0.0]])
    plate = found(geometry, start, (end - start) / np.linalg.norm(end - start[0]))[1]
    values = [Scattering(plate, torch.full((POINTS,), float(choice))).evaluate(GRID.directions)[0] for choice in choices]
    return torch.stack(values).mean(0)


@pytest.mark.parametrize("metallic, transmission, textured", [(0.5, 1.0, False), (0.25, 0.6, False), (0.5, 1.0, True)])
def test_metal_covers_what_is_transmissive(metallic, transmission, textured):
    """glTF mixes m metal + (1 - m) ((1 - t) opaque dielectric + t glass)."""
    metal, matte, glass = (
        mean_value(np.array([0.5]), metallic=m, transmission=t) for m, t in ((1.0, 0.0), (0.0, 0.0), (0.0, 1.0))
    )
    expected = metallic * metal + (1.0 - metallic) * ((1.0 - transmission) * matte + transmission * glass)
    choices = (np.arange(40) + 0.5) / 40  # the share of glass, 1/2 or 9/20, is a multiple of 1/40
    texture = Texture(np.full((1, 1, 3), (0.0, 1.0, metallic), np.float32)) if textured else None
    factor = 1.0 if textured else metallic
    value = mean_value(choices, metallic=factor, transmission=transmission, metallic_roughness_texture=texture)
    torch.testing.assert_close(value, expected, rtol=2e-3, atol=1e-4)


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
