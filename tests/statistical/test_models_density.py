"""The lens densities: draws against integrals, and the whole against 1."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from scipy import stats

from bokehguide.models.projection import lens_density, project_to_lens
from bokehguide.models.uniform import UniformLensDistribution
from tests.support.lens_cases import (
    CASES,
    INNER_RINGS,
    LENS,
    X_F,
    PolarGrid,
    grid,
    histogram_check,
    in_both_forms,
    plane,
)
from tests.support.statistical import SIGNIFICANCE, chi_square

DRAWS = 1_000_000
BY_NAME = pytest.mark.parametrize("case", in_both_forms(CASES), ids=lambda case: case.name)


@pytest.mark.slow
@BY_NAME
def test_draws_follow_the_density(case):
    """Over the plane, and as the share of draws inside the lens, whose integral is that of the inner rings."""
    cells = grid(case)
    probability = cells.integrate(case.pdf)
    observed = cells.count(case.draw(DRAWS, seed=1))
    assert histogram_check(observed, probability) > SIGNIFICANCE
    inside, share = int(observed[: INNER_RINGS * cells.sectors].sum()), float(probability[:INNER_RINGS].sum())
    assert stats.binomtest(inside, DRAWS, min(share, 1.0)).pvalue > SIGNIFICANCE


def gaussian_density(focus: torch.Tensor, mean: torch.Tensor, sigma: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Density `[N]` of one Gaussian through one focus point, `[3, 1]` both, at lens points `[2, N]`."""
    count = points.shape[1]
    return lens_density(points, focus.expand(3, count), mean.expand(3, count), sigma.expand(count))


@pytest.mark.slow
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
        density = partial(gaussian_density, focus.double(), mean[:, None].double(), sigma.double())
        cells = plane(abs(k) * float(sigma), centre)
        total += float(distribution.beta * weight) * cells.integrate(density).sum()
    assert total == pytest.approx(1.0, abs=1e-3)


def test_uniform_draws_fill_the_aperture_evenly():
    distribution = UniformLensDistribution(LENS)
    points = distribution.sample(torch.rand(2, DRAWS, generator=torch.Generator().manual_seed(3))).points
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
