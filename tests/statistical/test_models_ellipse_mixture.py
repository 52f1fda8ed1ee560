"""The mixture of ellipses: draws against the density, the density against 1 and against plain geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bokehguide.models import ellipse_mixture
from bokehguide.models.ellipse_mixture import EllipseMixture, overlap, packed
from bokehguide.models.projection import project_to_lens
from bokehguide.render.lens import Lens
from tests.support.lens_cases import (
    INNER_RINGS,
    LENS,
    X_F,
    EllipseCase,
    grid,
    in_both_forms,
    mean_through,
    means_of,
    probabilities,
)
from tests.support.statistical import SIGNIFICANCE, chi_square

DRAWS = 100_000
TURNED = ((0.05, 0.02, 0.0), (-0.004, 0.01, 0.02), (0.002, -0.005, 0.0022))
DEEP = ((0.05, 0.0, 0.0), (0.01, 0.04, 0.1), (0.1, 0.02, 0.7))
FLAT = ((0.0, 0.02, 0.01), (0.003, -0.01, 0.1), (0.0, 0.0, 0.0))

CASES = [
    EllipseCase("before", X_F, 1.0, mean_through(0.02, 0.01, 1.2), [0.01], [1.0]),
    EllipseCase("behind", X_F, 1.0, mean_through(-0.03, 0.02, 6.0), [0.06], [1.0]),
    EllipseCase("larger than the lens", X_F, 0.7, mean_through(0.0, 0.05, 2.2), [0.05], [1.0], reach=10.0),
    EllipseCase("centre outside", X_F, 1.0, mean_through(0.13, -0.02, 5.0), [0.08], [1.0]),
    EllipseCase("hardly seen", X_F, 1.0, mean_through(0.25, 0.05, 5.0), [0.24], [1.0]),
    EllipseCase("outside", X_F, 0.9, mean_through(0.3, -0.02, 5.0), [0.08], [1.0]),
    EllipseCase("ellipsoid", X_F, 1.0, mean_through(-0.03, 0.02, 6.0), [0.06], [1.0], axes=(TURNED,)),
    EllipseCase("deep", X_F, 1.0, mean_through(-0.1, 0.3, 3.3), [0.06], [1.0], reach=30.0, axes=(DEEP,)),
    EllipseCase("parallelogram at the side", X_F, 0.8, mean_through(1.0, 0.6, 6.0), [0.1], [1.0], reach=30.0, axes=(FLAT,)),
    EllipseCase(
        "ball and ellipsoid",
        X_F,
        0.9,
        means_of(mean_through(0.03, 0.03, 1.3), mean_through(0.0, 0.0, 5.0)),
        [0.02, 0.06],
        [1.0, 2.0],
        axes=(((0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.0)), TURNED),
    ),
    EllipseCase(
        "blend", X_F, 0.6, means_of(mean_through(0.0, 0.07, 1.5), mean_through(-0.05, 0.0, 4.0)), [0.01, 0.06], [1.0, 1.0]
    ),
    EllipseCase(
        "overlapping, of uneven weight",
        X_F,
        0.9,
        means_of(mean_through(0.03, 0.03, 1.3), mean_through(0.0, 0.0, 5.0), mean_through(0.05, 0.0, 9.0)),
        [0.02, 0.06, 0.2],
        [3.0, 1.0, 0.5],
    ),
]
BY_NAME = pytest.mark.parametrize("case", in_both_forms(CASES), ids=lambda case: case.name)


def test_uniform_samples_report_no_candidate():
    mixture = next(case for case in CASES if case.name == "blend").distribution(1000)
    uniforms = torch.rand(3, 1000, generator=torch.Generator().manual_seed(1))
    candidate = mixture.sample(uniforms).candidate
    assert torch.equal(candidate >= 0, uniforms[0] < mixture.beta) and set(candidate.tolist()) > {-1}


@pytest.mark.slow
@BY_NAME
def test_draws_follow_the_density(case):
    """Over the plane, and as the share of draws inside the lens."""
    cells = grid(case)
    probability = probabilities(case, cells)
    observed = cells.count(case.draw(DRAWS, seed=1))
    assert observed[-1] == 0  # no disc reaches beyond the grid
    assert chi_square(observed[:-1], probability.ravel() / probability.sum()) > SIGNIFICANCE
    inside, share = int(observed[: INNER_RINGS * cells.sectors].sum()), float(probability[:INNER_RINGS].sum())
    assert inside / DRAWS == pytest.approx(share, abs=2e-3 + 4.0 * math.sqrt(abs(share - share * share) / DRAWS))


@pytest.mark.slow
@BY_NAME
def test_the_density_integrates_to_one(case):
    assert probabilities(case, grid(case)).sum() == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("defect", ["area", "weights"])
def test_a_wrong_density_fails(defect, monkeypatch):
    case = next(case for case in CASES if case.name == "overlapping, of uneven weight")
    cells = grid(case)
    observed = cells.count(case.draw(DRAWS, seed=2))
    if defect == "area":
        right = EllipseMixture.component_pdf
        monkeypatch.setattr(EllipseMixture, "component_pdf", lambda self, points: 1.02 * right(self, points))
    else:
        monkeypatch.setattr(EllipseMixture, "mixture_pdf", lambda self, components: components.reshape(-1, 3).mean(1))
    probability = probabilities(case, cells)
    wrong_sum = abs(probability.sum() - 1.0) > 2e-3
    assert wrong_sum or chi_square(observed[:-1], probability.ravel() / probability.sum()) < SIGNIFICANCE


@pytest.mark.parametrize("name", ["behind", "ellipsoid", "parallelogram at the side", "deep"])
def test_an_outline_is_drawn_where_rays_through_it_leave_the_lens(name):
    """Point by point: all of the ellipsoid lies inside, and up to the edge everywhere."""
    case = next(case for case in CASES if case.name == name)
    distribution, count = case.distribution(1), 200_000
    directions = torch.nn.functional.normalize(torch.randn(3, count, generator=torch.Generator().manual_seed(0)).double(), dim=0)
    axes = torch.tensor(case.axes[0] if case.axes else case.sigma[0] * np.eye(3)).double()
    shell = torch.tensor(case.mean).double() + axes.T @ directions
    shown = project_to_lens(shell, distribution.focus.double().expand(3, count))
    x, y = shown - distribution.ellipses.center
    x = x / distribution.ellipses.width
    y = (y - distribution.ellipses.tilt * x) / distribution.ellipses.height
    size, angle = (x * x + y * y).sqrt(), torch.atan2(y, x)
    assert float(size.max()) < 1.0001
    for sector in torch.linspace(-math.pi, math.pi, 25)[:-1].tolist():
        inside = (angle >= sector) & (angle < sector + math.pi / 12)
        assert float(size[inside].max()) > 0.99


def test_of_what_reaches_the_focus_points_plane_something_is_drawn():
    """Its outline has no end; draws have one, and a density."""
    outline = packed(torch.tensor([[[0.01, 0.0, 0.1], [0.0, 0.01, 0.0], [0.1, 0.0, 9.0]]]))
    focus, ones = torch.tensor(X_F)[:, None], torch.ones(1)
    mean = torch.tensor([[0.0], [0.0], [X_F[2] + 1.5]])
    distribution = EllipseMixture(LENS, focus, ones, torch.arange(2), mean, outline, ones, ones)
    points = distribution.sample(torch.tensor([[0.5], [0.3], [0.7]])).points
    assert bool(points.isfinite().all()) and 0.0 < float(distribution.pdf(points)) < math.inf


def test_pixels_without_a_disc_on_the_lens_are_uniform():
    case = next(case for case in CASES if case.name == "outside")
    distribution = case.distribution(3)
    assert not distribution.guided.any()
    points = torch.tensor([[0.0, 0.05, 0.2], [0.0, 0.05, 0.0]])
    torch.testing.assert_close(distribution.pdf(points), torch.tensor([1.0, 1.0, 0.0]) / LENS.area)


def test_evenly_spread_numbers_give_evenly_spread_points():
    """The squares of a 32 × 32 raster of numbers each hold one point of the disc that it is stretched over."""
    case = next(case for case in CASES if case.name == "before")
    place = (torch.stack(torch.meshgrid(torch.arange(32), torch.arange(32), indexing="ij")).reshape(2, -1) + 0.5) / 32
    distribution = case.distribution(1024)
    points = distribution.sample(torch.cat((torch.full((1, 1024), 0.5), place))).points
    center, width, tilt, height, _ = distribution.ellipses
    x, y = points - center
    ring = (32 * ((x / width).square() + ((y - tilt * x / width) / height).square())).long()
    assert (torch.bincount(ring) == 32).all()


@pytest.mark.parametrize("x, radius, expected", [(0.0, 0.02, 1.0), (0.0, 0.2, 0.25), (0.13, 0.02, 0.0), (0.1, 0.02, 0.5)])
def test_overlap_with_the_lens(x, radius, expected):
    size, lens_radius = torch.tensor([radius]), torch.tensor(Lens(0.1, 2.0).radius)
    found = overlap(torch.tensor([[x], [0.0]]), size, 0.0 * size, size, lens_radius)
    assert float(found) == pytest.approx(expected, abs=0.06)
    turned = overlap(torch.tensor([[0.0], [x]]), 0.5 * size, size, size, lens_radius)
    assert (float(turned) > 0.0) == (x - 2.0**0.5 * radius < 0.1)  # so far it reaches up: hypot(1, 1)


def test_parts_of_a_disc_and_their_ends_belong_together():
    """`_disc_cdf` against the integral, and `_disc_quantile` against `_disc_cdf`."""
    place = torch.linspace(-1.0, 1.0, 2001, dtype=torch.float64)
    chord = 2.0 / math.pi * (1.0 - place * place).clamp(min=0.0).sqrt()
    share = torch.cat((torch.zeros(1), torch.cumulative_trapezoid(chord, place)))
    np.testing.assert_allclose(ellipse_mixture._disc_cdf(place.float()), share, atol=2e-5)
    found = ellipse_mixture._disc_quantile(ellipse_mixture._disc_cdf(place.float()))
    np.testing.assert_allclose(found, place, atol=2e-4)  # at the ends single precision tells no more
    np.testing.assert_allclose(found[50:-50], place[50:-50], atol=3e-6)


def test_what_the_lens_sees_is_drawn_and_what_it_cannot_see_is_not():
    """Discs and ellipses of all sizes all over the lens's plane: what lies in the lens counts as the whole ellipse does, by
    an even density, and at its edge few draws are lost."""
    generator = torch.Generator().manual_seed(3)
    count = 20_000
    focus = torch.tensor(X_F)[:, None].expand(3, count).contiguous()
    shown = LENS.radius * (3.0 * torch.rand(2, count, generator=generator) - 1.5)
    mean = torch.lerp(torch.cat((shown, torch.zeros(1, count))), focus, 2.5)
    axes = torch.randn(count, 3, 3, generator=generator) * 10.0 ** (1.7 * torch.rand(count, 1, 1, generator=generator) - 2.5)
    outline = packed(axes.transpose(1, 2) @ axes)
    ones = torch.ones(count)
    distribution = EllipseMixture(LENS, focus, ones, torch.arange(count + 1), mean, outline, ones, ones)
    center, width, tilt, height, clip = distribution.ellipses
    angle, radius = torch.rand(2, 50, count, generator=generator)
    angle, radius = 2.0 * math.pi * angle, 0.999 * radius.sqrt()
    x, y = radius * angle.cos(), radius * angle.sin()
    points = (center[:, None] + torch.stack((width * x, tilt * x + height * y))).reshape(2, -1)
    seen = points.square().sum(0).reshape(50, count) < LENS.radius**2
    density = torch.stack([distribution.component_pdf(part) for part in points.reshape(2, 50, count).unbind(1)])
    whole = 1.0 / (math.pi * width * height)
    assert bool((density[seen] > 0.0).all()) and 0.1 < float(seen.float().mean()) < 0.9
    torch.testing.assert_close(density[seen], (whole / clip.share).expand(50, -1)[seen])
    small = (torch.maximum(width, height) < 0.3 * LENS.radius) & distribution.guided & (clip.share < 0.95) & (clip.share > 0.05)
    drawn = distribution.sample(torch.rand(3, count, generator=generator)).points.square().sum(0) < LENS.radius**2
    assert int(small.sum()) > 500
    assert float(drawn[small].float().mean()) > 0.9 > 0.6 > float(seen[:, small].float().mean())
