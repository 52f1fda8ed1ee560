"""Glass: Fresnel's and Snell's laws, rough and smooth, solid and thin, from both sides."""

import math

import numpy as np
import pytest
import torch

from bokehguide.render.bsdf.dielectric import DELTA_PDF, DielectricBSDF, fresnel
from bokehguide.render.random import PixelRandom
from tests.support.scattering_formulas import reflectance, sheet_reflectance
from tests.support.sphere import SphereGrid, squeezed, surface, tilted, unsqueezed
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test

GRID = SphereGrid()
POINTS = GRID.directions.shape[1]
DRAWS = 200_000
WHITE = (1.0, 1.0, 1.0)

# Roughness, thin, seen from the front, degrees from the normal.
CASES = [
    (0.4, 0.0, 1.0, 0.0),
    (0.4, 0.0, 1.0, 60.0),
    (0.4, 0.0, 0.0, 20.0),
    (0.4, 0.0, 0.0, 41.0),  # about the critical angle
    (0.4, 1.0, 1.0, 40.0),
    (0.6, 0.0, 1.0, 75.0),
    (0.6, 0.0, 0.0, 60.0),
    (0.6, 1.0, 0.0, 75.0),
    (1.0, 0.0, 1.0, 30.0),
    (1.0, 0.0, 0.0, 0.0),
]


def uniforms(count: int, seed: int = 0) -> torch.Tensor:
    return PixelRandom(seed, 0, torch.arange(count)).uniform(0, 3)


def case_bsdf(case, count: int, base_color=(0.8, 0.5, 0.3)) -> DielectricBSDF:
    roughness, thin, front, degrees = case
    parameters = surface(count, base_color, roughness=roughness, transmission=1.0, thin=thin, front=front)
    return DielectricBSDF(tilted(degrees, count), parameters)


def fresnel_at(degrees: float, eta: float) -> float:
    return fresnel(torch.tensor([math.cos(math.radians(degrees))]), torch.tensor([eta])).item()


@pytest.mark.parametrize("eta", [1.5, 1.0 / 1.5, 1.33, 2.4])
def test_fresnel_is_the_exact_reflectance(eta):
    for degrees in (0.0, 20.0, 40.0, 55.0, 70.0, 85.0, 89.0):
        assert fresnel_at(degrees, eta) == pytest.approx(reflectance(math.cos(math.radians(degrees)), eta), abs=1e-4)


def test_fresnel_at_normal_incidence_is_that_of_the_index():
    assert fresnel_at(0.0, 1.5) == pytest.approx(0.04, abs=1e-6)
    assert fresnel_at(0.0, 1.0 / 1.5) == pytest.approx(0.04, abs=1e-6)
    assert fresnel_at(50.0, 1.0) == pytest.approx(0.0, abs=1e-6)


def test_at_brewsters_angle_only_one_polarisation_is_reflected():
    degrees = math.degrees(math.atan(1.5))
    cosine = math.cos(math.radians(degrees))
    transmitted = math.sqrt(1.0 - (1.0 - cosine**2) / 1.5**2)
    perpendicular = ((cosine - 1.5 * transmitted) / (cosine + 1.5 * transmitted)) ** 2
    assert fresnel_at(degrees, 1.5) == pytest.approx(0.5 * perpendicular, abs=1e-6)


def test_total_reflection_begins_at_the_critical_angle():
    critical = math.degrees(math.asin(1.0 / 1.5))
    assert fresnel_at(critical - 0.5, 1.0 / 1.5) < 0.8
    for degrees in (critical + 1e-3, 60.0, 89.99):
        assert fresnel_at(degrees, 1.0 / 1.5) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("front, eta", [(1.0, 1.5), (0.0, 1.0 / 1.5)])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 80.0])
def test_smooth_glass_reflects_and_refracts_by_snell_and_fresnel(front, eta, degrees):
    bsdf = case_bsdf((0.0, 0.0, front, degrees), DRAWS, WHITE)
    drawn, weight, pdf = bsdf.sample(uniforms(DRAWS))
    outgoing = tilted(degrees, DRAWS)
    below = drawn[2] < 0.0
    mirrored = outgoing * torch.tensor([-1.0, -1.0, 1.0])[:, None]
    torch.testing.assert_close(drawn[:, ~below], mirrored[:, ~below], atol=1e-5, rtol=0.0)
    torch.testing.assert_close(drawn[:2, below] * eta, -outgoing[:2, below], atol=1e-5, rtol=0.0)  # Snell
    assert torch.allclose(drawn.norm(dim=0), torch.ones(()), atol=1e-5)
    assert (pdf >= DELTA_PDF).all()
    # Radiance gains η² on its way in: energy is conserved as R + T η² = 1, and no draw is lost.
    assert (weight[:, ~below] == 1.0).all()
    assert torch.allclose(weight[:, below] * eta**2, torch.ones(()), atol=1e-6)
    expected = float(reflectance(math.cos(math.radians(degrees)), eta))
    error = math.sqrt(max(expected * (1.0 - expected), 1e-12) / DRAWS)
    assert z_test(float((~below).double().mean()) - expected, error) > SIGNIFICANCE


@pytest.mark.parametrize("degrees", [0.0, 45.0, 75.0])
def test_a_smooth_thin_sheet_sends_light_straight_through(degrees):
    drawn, weight, _ = case_bsdf((0.0, 1.0, 1.0, degrees), DRAWS, (0.9, 0.5, 0.2)).sample(uniforms(DRAWS))
    below = drawn[2] < 0.0
    torch.testing.assert_close(drawn[:, below], -tilted(degrees, DRAWS)[:, below], atol=1e-5, rtol=0.0)
    assert torch.allclose(weight[:, below], torch.tensor([0.9, 0.5, 0.2])[:, None])
    assert (weight[:, ~below] == 1.0).all()
    expected = float(sheet_reflectance(math.cos(math.radians(degrees)), 1.5))
    error = math.sqrt(expected * (1.0 - expected) / DRAWS)
    assert z_test(float((~below).double().mean()) - expected, error) > SIGNIFICANCE


def test_smooth_glass_is_black_to_light_sampling():
    value, pdf = case_bsdf((0.0, 0.0, 1.0, 30.0), POINTS).evaluate(GRID.directions)
    assert not value.any() and not pdf.any()


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_draws_follow_the_density(case):
    drawn, weight, _ = case_bsdf(case, DRAWS).sample(uniforms(DRAWS))
    assert torch.allclose(drawn.norm(dim=0), torch.ones(()), atol=1e-4)
    _, pdf = case_bsdf(case, POINTS).evaluate(GRID.directions)
    cells = GRID.cell_integrals(pdf)
    assert 0.4 < cells.sum() < 1.002
    # Draws on the wrong side of the horizon carry nothing and have no density.
    lost = (weight == 0.0).all(0)
    assert lost.double().mean() == pytest.approx(max(1.0 - cells.sum(), 0.0), abs=5e-3)
    counts = np.append(GRID.histogram(drawn[:, ~lost]), int(lost.sum()))
    expected = np.append(cells, max(1.0 - cells.sum(), 1e-6))
    assert chi_square(counts, expected / expected.sum()) > SIGNIFICANCE


@pytest.mark.parametrize("case", CASES)
def test_weights_of_draws_are_value_over_density_and_average_to_the_quadrature(case):
    bsdf = case_bsdf(case, DRAWS)
    drawn, weight, pdf = bsdf.sample(uniforms(DRAWS, seed=1))
    value, density = bsdf.evaluate(drawn)
    kept = (weight > 0.0).all(0)
    torch.testing.assert_close(density, pdf)
    torch.testing.assert_close((value / density)[:, kept], weight[:, kept], rtol=1e-3, atol=1e-4)
    grid_value, _ = case_bsdf(case, POINTS).evaluate(GRID.directions)
    total = GRID.integral(grid_value)
    weights = weight.double().numpy()
    error = weights.std(axis=1) / math.sqrt(DRAWS) + 1e-3 * total  # the quadrature's own
    assert z_test(weights.mean(axis=1) - total, error) > SIGNIFICANCE


def glass_lobes(case) -> tuple[np.ndarray, np.ndarray, float]:
    """Cells' probabilities over half vectors as the roughest glass would have them, reflected and refracted, and α."""
    roughness, thin, front, degrees = case
    alpha, outgoing = roughness**2, tilted(degrees, 1).double().numpy()
    eta = relative_index(thin, front)
    half, jacobian = squeezed(GRID.directions.double().numpy(), alpha)
    cosine = np.maximum((outgoing * half).sum(0), 0.0)
    mirrored = 2.0 * cosine * half - outgoing
    transmitted = np.sqrt(np.maximum(1.0 - (1.0 - cosine**2) / eta**2, 1e-12))  # total reflection has no density below
    refracted = (cosine / eta - transmitted) * half - outgoing / eta
    spread = (cosine - eta * transmitted) ** 2 / (eta**2 * transmitted)  # dω(refracted) / dω(half)
    if thin:
        refracted, spread = mirrored * [[1.0], [1.0], [-1.0]], 4.0 * cosine
    lobes = []
    for direction, per_half, side in ((mirrored, 4.0 * cosine, 1.0), (refracted, spread, -1.0)):
        _, pdf = case_bsdf(case, POINTS).evaluate(torch.from_numpy(direction).float())
        exists = (half[2] > 0.0) & (cosine > 1e-6) & (direction[2] * side > 0.0)
        lobes.append(GRID.cell_integrals(torch.from_numpy(np.where(exists, pdf.numpy() * per_half * jacobian, 0.0))))
    return lobes[0], lobes[1], alpha


def relative_index(thin: float, front: float) -> float:
    return 1.5 if thin or front else 1.0 / 1.5


@pytest.mark.parametrize("roughness", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("thin, front, degrees", [(0.0, 1.0, 0.0), (0.0, 1.0, 70.0), (0.0, 0.0, 25.0), (1.0, 1.0, 60.0)])
def test_draws_of_narrow_lobes_follow_the_density_of_their_half_vectors(thin, front, degrees, roughness):
    case = (roughness, thin, front, degrees)
    reflected, refracted, alpha = glass_lobes(case)
    drawn, weight, _ = case_bsdf(case, DRAWS).sample(uniforms(DRAWS, seed=5))
    drawn = drawn[:, (weight > 0.0).any(0)].double().numpy()
    below, outgoing = drawn[2] < 0.0, tilted(degrees, 1).double().numpy()
    up, down = drawn[:, ~below], drawn[:, below]
    half = down * [[1.0], [1.0], [-1.0]] + outgoing if thin else outgoing + relative_index(thin, front) * down
    half = half * np.sign(half[2])
    counts = [GRID.histogram(torch.from_numpy(unsqueezed(h, alpha))) for h in (up + outgoing, half)]
    counts = np.concatenate((*counts, [DRAWS - drawn.shape[1]]))
    expected = np.concatenate((reflected, refracted))
    lost = 1.0 - expected.sum()
    assert -2e-3 < lost < 0.2
    expected = np.append(expected + 1e-8, max(lost, 1e-4))  # rounding moves draws at the critical angle
    assert chi_square(counts, expected / expected.sum()) > SIGNIFICANCE


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.8, 1.0])
def test_refraction_is_reciprocal_up_to_the_square_of_the_index(roughness):
    """f(o, i) η² seen from outside equals f(i, o) seen from inside, and reflection is symmetric."""
    incoming = GRID.directions[:, ::103]
    incoming = incoming[:, incoming[2].abs() > 0.05]
    count = incoming.shape[1]
    outgoing = tilted(35.0, count)
    below = incoming[2] < 0.0
    parameters = surface(count, WHITE, roughness=roughness, transmission=1.0)
    there, _ = DielectricBSDF(outgoing, parameters).evaluate(incoming)
    sign = 1.0 - 2.0 * below.float()
    parameters.front = (~below).float()  # seen from below, the frame is turned over
    turn = torch.stack((torch.ones(count), sign, sign))
    back, _ = DielectricBSDF(incoming * turn, parameters).evaluate(outgoing * turn)
    there = there[0] / incoming[2].abs() * torch.where(below, 2.25, 1.0)
    back = back[0] / outgoing[2]
    assert (there[below] > 1e-3).sum() > 20
    torch.testing.assert_close(there, back, rtol=5e-3, atol=1e-5)


@pytest.mark.parametrize("roughness", [0.0, 0.3])
@pytest.mark.parametrize("ior", [1.0, 1.0001])
def test_a_solid_that_does_not_bend_light_lets_it_through(ior, roughness):
    count = 1000
    outgoing = tilted(40.0, count)
    glass = DielectricBSDF(outgoing, surface(count, WHITE, roughness=roughness, transmission=1.0, ior=ior))
    incoming, weight, pdf = glass.sample(uniforms(count))
    assert bool(weight.isfinite().all()) and bool(pdf.isfinite().all())
    assert float(weight.mean()) == pytest.approx(1.0, abs=0.02)
    assert (incoming + outgoing).abs().max() < (1e-3 if ior == 1.0 else 0.02)
