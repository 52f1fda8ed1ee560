"""The lens densities: draws against integrals, and the whole against 1."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from lens_cases import INNER_RINGS, LENS, LensCase, PolarGrid, grid, histogram_check, plane
from scipy import stats
from statistical import SIGNIFICANCE, chi_square

from bokehguide.models.lens_distribution import UniformLensDistribution
from bokehguide.models.projection import lens_density, project_to_lens
from bokehguide.render.lens import Lens

DRAWS = 1_000_000
X_F = (0.3, -0.2, 2.0)


def spot(x: float, y: float, z: float) -> list[list[float]]:
    """The mean `[3, 1]` whose projection through X_F is the lens point (x, y), at depth z."""
    k = X_F[2] / (X_F[2] - z)
    return [[X_F[0] + (x - X_F[0]) / k], [X_F[1] + (y - X_F[1]) / k], [z]]


def mixture(*means: list[list[float]]) -> list[list[float]]:
    return np.concatenate(means, 1).tolist()


CASES = [
    LensCase("before", X_F, 1.0, spot(0.02, 0.01, 1.2), [0.01], [1.0]),
    LensCase("behind", X_F, 1.0, spot(-0.03, 0.02, 6.0), [0.06], [1.0]),
    LensCase("almost in focus", X_F, 1.0, spot(0.0, 0.05, 2.002), [0.05], [1.0], reach=1000.0),
    LensCase("before the lens's rim", X_F, 1.0, spot(0.05, 0.05, 0.1), [0.02], [1.0]),
    LensCase("environment", X_F, 1.0, spot(0.03, 0.0, 2000.0), [40.0], [1.0]),
    LensCase("centre outside", X_F, 1.0, spot(0.13, -0.02, 5.0), [0.08], [1.0]),
    LensCase(
        "mixture",
        X_F,
        1.0,
        mixture(spot(0.03, 0.03, 1.3), spot(-0.06, 0.0, 5.0), spot(0.1, -0.05, 9.0)),
        [0.01, 0.04, 0.1],
        [3.0, 1.0, 0.5],
    ),
    LensCase("one of two culled", X_F, 1.0, mixture(spot(0.4, 0.0, 5.0), spot(0.0, 0.06, 5.0)), [0.03, 0.03], [5.0, 1.0]),
    LensCase("blend", X_F, 0.6, mixture(spot(0.0, 0.07, 1.5), spot(-0.05, 0.0, 4.0)), [0.01, 0.03], [1.0, 1.0]),
    LensCase("all culled", X_F, 0.9, spot(0.5, 0.5, 6.0), [0.03], [1.0]),
    LensCase("a wide lens", (1.0, -0.5, 1.0), 0.8, [[2.0], [-1.4], [3.0]], [0.6], [1.0], reach=30.0, lens=Lens(0.5, 1.0)),
]
BY_NAME = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


@BY_NAME
def test_draws_follow_the_density(case):
    """Over the plane, and as the share of draws inside the lens, whose integral is that of the inner rings."""
    cells = grid(case)
    probability = cells.integrate(case.pdf)
    observed = cells.count(case.draw(DRAWS, seed=1))
    assert histogram_check(observed, probability) > SIGNIFICANCE
    inside, share = int(observed[: INNER_RINGS * cells.sectors].sum()), float(probability[:INNER_RINGS].sum())
    assert stats.binomtest(inside, DRAWS, min(share, 1.0)).pvalue > SIGNIFICANCE


@BY_NAME
def test_the_density_integrates_to_one(case):
    """Each candidate on a grid about its own projection; the blend's uniform part is exact."""
    distribution = case.distribution(1)
    total = 1.0 - float(distribution.beta)
    for weight, mean, sigma in zip(distribution.weight, distribution.mean.T, distribution.sigma):
        if weight == 0.0:
            continue
        focus = distribution.focus
        k = float(focus[2] / (focus[2] - mean[2]))
        centre = project_to_lens(mean[:, None], focus)[:, 0].tolist()

        def density(points, mean=mean[:, None].double(), sigma=sigma.double()):
            count = points.shape[1]
            return lens_density(points, focus.double().expand(3, count), mean.expand(3, count), sigma.expand(count))

        cells = plane(abs(k) * float(sigma), centre)
        total += float(distribution.beta * weight) * cells.integrate(density).sum()
    assert total == pytest.approx(1.0, abs=1e-3)


def test_uniform_draws_fill_the_aperture_evenly():
    distribution = UniformLensDistribution(LENS)
    points = distribution.sample(torch.rand(2, DRAWS, generator=torch.Generator().manual_seed(3)))
    cells = PolarGrid(LENS.radius * np.sqrt(np.arange(17) / 16.0))
    probability = cells.integrate(distribution.pdf).ravel()
    assert probability.sum() == pytest.approx(1.0, abs=1e-6)
    # A draw on the very rim may be rounded to the outside: one in a million.
    assert chi_square(cells.count(points)[:-1], probability / probability.sum()) > SIGNIFICANCE
    assert not distribution.pdf(torch.tensor([[0.1001, -0.08], [0.0, 0.08]])).any()


def test_a_gaussian_in_focus_is_seen_alike_from_all_over_the_lens():
    """With its mean in x_F the density is cosθ / (2π d²), however large the spot is."""
    points = torch.tensor([[0.0, 0.1, 1.0, -3.0], [0.0, 0.0, 2.0, 1.0]], dtype=torch.float64)
    focus = torch.tensor(X_F, dtype=torch.float64)[:, None].expand(3, 4)
    distance = ((points - focus[:2]).square().sum(0) + focus[2].square()).sqrt()
    density = lens_density(points, focus, focus, torch.full((4,), 0.01, dtype=torch.float64))
    torch.testing.assert_close(density, X_F[2] / (2.0 * math.pi * distance**3))


def test_pixels_without_a_candidate_are_uniform():
    case = next(case for case in CASES if case.name == "all culled")
    distribution = case.distribution(3)
    points = torch.tensor([[0.0, 0.05, 0.2], [0.0, 0.05, 0.0]])
    assert not distribution.guided.any()
    torch.testing.assert_close(distribution.pdf(points), torch.tensor([1.0, 1.0, 0.0]) / LENS.area)
    assert distribution.log_prob(points)[2] == -math.inf
