"""Clear coats with normals of their own: their value, sampling and energy, and where light may come from."""

import math

import numpy as np
import pytest
import torch

from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.bsdf.opaque import OpaqueBSDF
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import dot
from tests.support.scattering_formulas import tilted_clearcoat
from tests.support.sphere import SphereGrid, surface, tilted
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test

GRID = SphereGrid()
POINTS = GRID.directions.shape[1]
DRAWS = 200_000
BLACK = {"base_color": (0.0, 0.0, 0.0), "specular": 0.0}


def leaning(degrees: float) -> np.ndarray:
    """A normal at an angle to z, out of the plane of `tilted` directions: away from them, or towards them if negative."""
    angle, azimuth = math.radians(degrees), 2.9
    return np.array([math.sin(angle) * math.cos(azimuth), math.sin(angle) * math.sin(azimuth), math.cos(angle)])


def wide(clearcoat_roughness: float, clearcoat: float = 1.0, **others) -> dict:
    return {"clearcoat": clearcoat, "clearcoat_roughness": clearcoat_roughness, **others}


# Degrees from the base's normal to the viewer and to the coat's normal, and the material.
CASES = [
    (0.0, 25.0, wide(0.4, roughness=0.6)),
    (40.0, 30.0, wide(0.6, 0.7, roughness=0.4, metallic=1.0)),
    (70.0, 15.0, wide(0.5, roughness=0.8, specular_color=(1.0, 0.5, 0.1), metallic=0.2)),
    (20.0, 60.0, wide(0.5, roughness=0.5)),
    (30.0, 40.0, wide(0.35, **BLACK)),
    (80.0, -50.0, wide(0.6, 0.3, roughness=0.9, metallic=1.0)),
]

TRANSMITTING = [
    (degrees, lean, parameters | {"diffuse_transmission": factor, "transmission_color": (0.8, 0.9, 0.2)})
    for factor, numbers in ((0.0, (1, 3)), (0.7, (0, 3, 4, 5)))
    for degrees, lean, parameters in (CASES[number] for number in numbers)
]
"""With diffuse transmission, of the surface or of another material of its scene."""


def tilted_bsdf(case, count: int, outgoing: torch.Tensor | None = None) -> OpaqueBSDF:
    degrees, lean, parameters = case
    outgoing = tilted(degrees, count) if outgoing is None else outgoing
    normal = torch.tensor(leaning(lean), dtype=torch.float32)[:, None].expand(3, count)
    return OpaqueBSDF(outgoing, surface(count, **parameters), normal)


def uniforms(count: int, seed: int = 0) -> torch.Tensor:
    return PixelRandom(seed, 0, torch.arange(count)).uniform(0, 3)


@pytest.mark.parametrize("case", CASES)
def test_the_value_is_that_of_two_layers_with_their_own_cosines(case):
    degrees, lean, parameters = case
    normal = leaning(lean)
    incoming = GRID.directions[:, ::97]
    cosines = np.abs([incoming[2].numpy(), normal @ incoming.double().numpy()])
    incoming = incoming[:, (cosines > 0.02).all(0)]
    value, _ = tilted_bsdf(case, incoming.shape[1]).evaluate(incoming)
    x = np.cross(normal, [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    frame = np.stack((x, np.cross(normal, x), normal))
    outgoing = tilted(degrees, incoming.shape[1]).double().numpy()
    expected = tilted_clearcoat(outgoing, incoming.double().numpy(), frame, **parameters)
    np.testing.assert_allclose(value.numpy(), expected, rtol=3e-3, atol=1e-6)
    assert ((incoming[2] < 0.0) & torch.from_numpy(expected[0] > 1e-3)).any() or abs(lean) <= 30.0


@pytest.mark.parametrize("case", CASES)
def test_draws_follow_the_density_which_misses_only_what_is_below_both_horizons(case):
    drawn = tilted_bsdf(case, DRAWS).sample(uniforms(DRAWS))
    assert torch.allclose(drawn.norm(dim=0), torch.ones(()), atol=1e-5)
    normal = torch.tensor(leaning(case[1]), dtype=torch.float32)[:, None]

    def above(directions):
        return torch.maximum(directions[2], dot(directions, normal)) > 0.0

    _, pdf = tilted_bsdf(case, POINTS).evaluate(GRID.directions)
    assert ((pdf > 0.0) <= above(GRID.directions)).all()
    # The coat's horizon crosses cells, where the quadrature is coarse: they and the lost draws are one cell.
    share = GRID.cell_integrals(above(GRID.directions).float()) / GRID.cell_integrals(torch.ones(POINTS))
    clear = share > 0.999
    counts, cells = GRID.histogram(drawn[:, above(drawn)])[clear], GRID.cell_integrals(pdf)[clear]
    rest = 1.0 - cells.sum()
    assert -1e-3 < rest < 0.5
    counts, expected = np.append(counts, DRAWS - counts.sum()), np.append(cells, max(rest, 0.0) + 1e-6)
    assert chi_square(counts, expected / expected.sum()) > SIGNIFICANCE


@pytest.mark.parametrize("case", CASES)
def test_densities_and_the_share_of_lost_draws_add_up_to_1(case):
    _, pdf = tilted_bsdf(case, POINTS).evaluate(GRID.directions)
    bsdf = tilted_bsdf(case, DRAWS)
    _, density = bsdf.evaluate(bsdf.sample(uniforms(DRAWS, seed=1)))
    lost = float((density == 0.0).double().mean())
    error = math.sqrt(max(lost * (1.0 - lost), 1e-6) / DRAWS) + 5e-4  # the quadrature's own
    assert z_test(GRID.integral(pdf) + lost - 1.0, error) > SIGNIFICANCE


@pytest.mark.parametrize("case", TRANSMITTING)
def test_draws_follow_the_density_on_both_sides_of_the_surface(case):
    _, pdf = tilted_bsdf(case, POINTS).evaluate(GRID.directions)
    bsdf = tilted_bsdf(case, DRAWS)
    drawn = bsdf.sample(uniforms(DRAWS, seed=4))
    assert bool((bsdf.evaluate(drawn)[1] > 1e-6).all())
    cells = GRID.cell_integrals(pdf)
    assert cells.sum() == pytest.approx(1.0, abs=3e-3)  # the quadrature's own
    assert chi_square(GRID.histogram(drawn), cells / cells.sum()) > SIGNIFICANCE


@pytest.mark.parametrize("case", CASES + TRANSMITTING)
def test_the_mean_weight_of_draws_is_the_albedo_by_quadrature(case):
    numbers = uniforms(DRAWS, seed=2)
    assert GRID.albedo_check(tilted_bsdf(case, POINTS), tilted_bsdf(case, DRAWS), numbers) > SIGNIFICANCE


@pytest.mark.parametrize("case", CASES)
def test_each_layer_is_reciprocal_without_multiple_scattering(case):
    """Over black the coat is alone; what it adds is what is left of the base."""
    degrees, lean, parameters = case[0], case[1], case[2] | {"single_scattering": 1.0}
    normal = torch.tensor(leaning(lean), dtype=torch.float32)[:, None]
    incoming = GRID.directions[:, ::101]
    incoming = incoming[:, (incoming[2] > 0.05) & (dot(incoming, normal) > 0.05)]
    count = incoming.shape[1]
    outgoing = tilted(degrees, count)

    def layers(viewer, light):
        bare = parameters | BLACK | {"metallic": 0.0}
        both, coat = (tilted_bsdf((degrees, lean, p), count, viewer).evaluate(light)[0] for p in (parameters, bare))
        return coat / dot(light, normal), (both - coat) / light[2]

    for there, back in zip(layers(outgoing, incoming), layers(incoming, outgoing)):
        torch.testing.assert_close(there, back, rtol=3e-3, atol=2e-5)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0])
def test_a_normal_of_its_own_that_is_the_bases_changes_nothing(degrees):
    parameters = wide(0.3, 0.8, roughness=0.5)
    plain = OpaqueBSDF(tilted(degrees, POINTS), surface(POINTS, **parameters))
    own = tilted_bsdf((degrees, 0.0, parameters), POINTS)
    for a, b in zip(plain.evaluate(GRID.directions), own.evaluate(GRID.directions)):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(plain.sample(uniforms(POINTS)), own.sample(uniforms(POINTS)), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("beneath", [{"metallic": 1.0, "roughness": 0.1}, {"roughness": 0.5}])
def test_tilted_coats_create_nothing(beneath, roughness):
    parameters = {"base_color": (1.0, 1.0, 1.0)} | wide(roughness) | beneath
    most = 0.0
    for lean in (10.0, 35.0, 70.0):
        for degrees in (0.0, 40.0, 75.0, 86.0):
            normal = torch.tensor(leaning(lean), dtype=torch.float32)
            if (tilted(degrees, 1)[:, 0] * normal).sum() < 1e-4:
                continue  # the coat's normal would have given way
            bsdf = tilted_bsdf((degrees, lean, parameters), 50_000)
            value, pdf = bsdf.evaluate(bsdf.sample(uniforms(50_000, seed=3)))
            weights = (value / pdf.clamp(min=1e-20)).double()
            assert weights.isfinite().all()
            most = max(most, float(weights.mean() - 4.0 * weights[0].std() / math.sqrt(50_000)))
    assert 0.8 < most < 1.001


GEOMETRIC, BASE, COAT = (0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (-0.48, 0.36, 0.8)


def scattering(count: int, choice: float | None = None, **changes) -> Scattering:
    parameters = wide(0.5, roughness=0.6, normal=BASE, geometric_normal=GEOMETRIC, clearcoat_normal=COAT) | changes
    outgoing = torch.tensor((0.1, -0.2, 0.97))[:, None].expand(3, count)
    outgoing = torch.nn.functional.normalize(outgoing, dim=0)
    chosen = None if choice is None else torch.full((count,), choice)
    return Scattering(surface(count, outgoing=outgoing, **parameters), chosen)


def test_each_lobe_ends_at_its_own_horizon_and_both_at_that_of_the_geometry():
    value, _ = scattering(POINTS).evaluate(GRID.directions)
    cosines = torch.stack([dot(GRID.directions, torch.tensor(normal)[:, None]) for normal in (BASE, COAT, GEOMETRIC)])
    clear = (cosines.abs() > 1e-4).all(0)
    base, coat, outside = cosines > 0.0
    assert not value[:, clear & (~outside | (~base & ~coat))].any()
    for lit in (base & coat, base & ~coat, ~base & coat):
        assert (value[:, lit & outside] > 0.0).any()
    black, _ = scattering(POINTS, **BLACK).evaluate(GRID.directions)
    assert not black[:, clear & ~coat].any()


def test_draws_in_world_space_average_to_the_integral_of_the_values():
    expected = GRID.integral(scattering(POINTS).evaluate(GRID.directions)[0])
    joined = scattering(DRAWS)
    drawn, weight, _ = joined.sample(uniforms(DRAWS))
    weights = weight.double().numpy()
    error = weights.std(axis=1) / math.sqrt(DRAWS) + 2e-3 * expected  # the quadrature's own at the horizons
    assert z_test(weights.mean(axis=1) - expected, error) > SIGNIFICANCE
    value, density = joined.evaluate(drawn)
    kept = (weight > 1e-3).all(0)
    torch.testing.assert_close((value / density)[:, kept], weight[:, kept], rtol=2e-2, atol=1e-3)


def test_glass_does_not_see_the_coats_normal():
    glass = {"transmission": 1.0, "choice": 0.5}
    for normal in (COAT, BASE):
        value, pdf = scattering(POINTS, clearcoat_normal=normal, **glass).evaluate(GRID.directions)
        expected, density = scattering(POINTS, clearcoat_normal=None, **glass).evaluate(GRID.directions)
        assert torch.equal(value, expected) and torch.equal(pdf, density)
        drawn, plain = (scattering(1000, clearcoat_normal=n, **glass).sample(uniforms(1000)) for n in (normal, None))
        assert all(map(torch.equal, drawn, plain))
