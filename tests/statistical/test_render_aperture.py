"""Apertures of any shape: what passes, against plain geometry; and draws, against what passes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.kl import blend_gradient
from bokehguide.models.uniform import UniformLensDistribution
from bokehguide.render.lens import Lens, make_lens
from bokehguide.runtime import native
from bokehguide.scene.types import Aperture, Camera
from tests.support.aperture_cases import RADIUS, plain_transmission
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test

FOCUS, CORNER = 2.0, 0.5
DRAWS = 400_000
CELLS, FINE = 24, 28
"""Cells of a histogram across the lens, and points of each cell's integral across it."""

MASK = np.zeros((20, 13), np.float32)
"""A leaning, uneven L with a hole."""
MASK[2:18, 2:5], MASK[15:18, 2:12], MASK[8, 3] = 0.5, 1.0, 0.0
MASK[2:18, 2:5] += np.linspace(0.0, 0.5, 16, dtype=np.float32)[:, None]

SHAPES = {
    "triangle": Aperture(blades=3),
    "pentagon, turned": Aperture(blades=5, rotation=17.0),
    "square": Aperture(blades=4, rotation=45.0, edge=-1.0),
    "arcs": Aperture(blades=3, curvature=0.6, rotation=-30.0),
    "arcs, almost straight": Aperture(blades=6, curvature=1e-3),
    "arcs, almost round": Aperture(blades=7, curvature=0.97, edge=0.5),
    "arcs, round": Aperture(blades=3, curvature=1.0, edge=1.0),
    "oval": Aperture(ratio=1.7),
    "lying": Aperture(blades=5, rotation=90.0, curvature=0.3, ratio=0.6, edge=0.8),
    "bright rim": Aperture(edge=1.0),
    "bright centre": Aperture(edge=-0.7),
    "mask": Aperture(image=MASK),
    "mask, turned and squeezed": Aperture(image=MASK, rotation=110.0, ratio=1.4),
    "one texel": Aperture(image=np.ones((1, 1), np.float32)),
}
BY_SHAPE = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())


def lens_of(shape: Aperture | None, radius: float = RADIUS) -> Lens:
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), aperture_radius=radius, focus_distance=FOCUS, aperture=shape)
    return make_lens(camera, CORNER, "cpu")


def square_grid(extent: float) -> tuple[torch.Tensor, float]:
    """Points `[2, (CELLS · FINE)²]` of a square of this half side, cell by cell, and the area of each.

    Each lies anywhere in its little square, or a rim that runs along the grid would be off by half of one.
    """
    side = CELLS * FINE
    place = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="xy")) + np.random.default_rng(1).random(
        (2, side, side)
    )
    by_cell = (extent * (2.0 * place / side - 1.0)).reshape(2, CELLS, FINE, CELLS, FINE).transpose(0, 1, 3, 2, 4)
    return torch.from_numpy(by_cell.reshape(2, -1)), (2.0 * extent / (CELLS * FINE)) ** 2


def cell_integrals(values: torch.Tensor, area: float) -> np.ndarray:
    return values.double().numpy().reshape(CELLS * CELLS, -1).sum(1) * area


def counts(points: torch.Tensor, extent: float) -> np.ndarray:
    """Draws in each cell, and at the end those beyond the grid."""
    column, row = np.floor((points.double().numpy() / extent + 1.0) * (CELLS / 2.0)).astype(int)
    inside = (column >= 0) & (column < CELLS) & (row >= 0) & (row < CELLS)
    return np.bincount(np.where(inside, row * CELLS + column, CELLS * CELLS), minlength=CELLS * CELLS + 1)


def uniform_numbers(count: int, seed: int, rows: int = 2) -> torch.Tensor:
    """The numbers of a render: multiples of 2^-23 shifted by half a step."""
    bits = torch.randint(0, 1 << 23, (rows, count), generator=torch.Generator().manual_seed(seed))
    return (bits + 0.5) / 2.0**23


def draws_check(lens: Lens, seed: int = 1) -> float:
    """p-value of the draws against the density, which must integrate to 1."""
    distribution, extent = UniformLensDistribution(lens), 1.01 * lens.radius
    points, area = square_grid(extent)
    probability = cell_integrals(distribution.pdf(points.float()), area)
    assert probability.sum() == pytest.approx(1.0, abs=2e-3)
    observed = counts(distribution.sample(uniform_numbers(DRAWS, seed)).points, extent)
    probability = np.maximum(probability, 1e-9)  # a rim may pass between all points of a cell's integral
    return chi_square(observed, np.append(probability / probability.sum(), 0.0))


@BY_SHAPE
def test_what_passes_is_what_geometry_says(shape):
    lens = lens_of(shape)
    points = lens.radius * (2.0 * uniform_numbers(20_000, 8).double() - 1.0)
    expected = plain_transmission(shape, points.numpy())
    found = lens.transmission(points.float()).double().numpy()
    if shape.image is not None:  # `plain_transmission` knows it but for a factor
        expected *= found.max() / expected.max()
    np.testing.assert_allclose(found, expected, atol=2e-3)
    np.testing.assert_array_equal(lens.contains(points.float()).numpy(), found > 0.0)
    reach = np.hypot(*points.numpy()[:, found > 0.0]).max()
    assert 0.9 * lens.radius < reach < (1.0 + 1e-5) * lens.radius


@BY_SHAPE
def test_draws_follow_the_transmission(shape):
    assert draws_check(lens_of(shape)) > SIGNIFICANCE


@BY_SHAPE
def test_no_draw_is_lost(shape):
    """What is drawn passes, but for tents that rounding ends early; W / A is never infinite."""
    lens = lens_of(shape)
    passing = lens.transmission(lens.sample(uniform_numbers(DRAWS, 2)))
    assert (passing == 0.0).double().mean() < 1e-4
    assert passing.isfinite().all()


@pytest.mark.parametrize("far", [1e12, 1e15, 1e30])
@pytest.mark.parametrize("shape", [Aperture(blades=5), Aperture(edge=1.0), Aperture(image=MASK)])
def test_nothing_passes_far_outside(shape, far):
    points = torch.tensor([[far, -far, 0.0], [0.0, far, -far]])
    assert not lens_of(shape, radius=1e-6).transmission(points).any()


@pytest.mark.parametrize(
    "shape, area",
    [
        (Aperture(blades=3), 3.0 * math.sqrt(3.0) / 4.0),
        (Aperture(blades=4, ratio=2.0, edge=1.0), 1.0),
        (Aperture(blades=6, rotation=12.0), 1.5 * math.sqrt(3.0)),
        (Aperture(blades=5, curvature=1.0), math.pi),
        (Aperture(edge=-1.0, ratio=0.5), 2.0 * math.pi),
        (Aperture(image=np.ones((4, 8), np.float32)), 9.0 * 5.0 / 16.0),
    ],
)
def test_area_in_closed_form(shape, area):
    assert lens_of(shape).area == pytest.approx(area * RADIUS**2, rel=1e-9)


@pytest.mark.parametrize("blades", [3, 5, 8])
@pytest.mark.parametrize("curvature", [0.02, 0.5, 0.9])
def test_area_of_arcs_is_a_polygon_and_circular_segments(blades, curvature):
    angle = 2.0 * math.asin(curvature * math.sin(math.pi / blades))
    polygon = 0.5 * blades * math.sin(2.0 * math.pi / blades)
    segments = 0.5 * blades * (angle - math.sin(angle)) / curvature**2
    expected = (polygon + segments) * RADIUS**2
    assert lens_of(Aperture(blades=blades, curvature=curvature)).area == pytest.approx(expected, rel=1e-9)


def test_area_by_monte_carlo():
    for shape in SHAPES.values():
        lens = lens_of(shape)
        points = lens.radius * (2.0 * uniform_numbers(DRAWS, 5) - 1.0)
        share = lens.area / (2.0 * lens.radius) ** 2
        error = math.sqrt(share * (1.0 - share) / DRAWS)
        assert z_test(lens.contains(points).double().mean() - share, error) > SIGNIFICANCE


def test_corners_of_an_iris():
    """As in Blender: an edge's middle to the right at 0°, turned anticlockwise; the ratio divides the width."""
    lens = lens_of(Aperture(blades=3, ratio=2.0))
    corner = RADIUS * torch.tensor([[0.25, 0.25, -0.5], [math.sqrt(0.75), -math.sqrt(0.75), 0.0]])
    assert lens.contains(0.999 * corner).all() and not lens.contains(1.001 * corner).any()
    lens = lens_of(Aperture(blades=3, rotation=90.0))
    assert lens.contains(torch.tensor([[0.0], [-0.999 * RADIUS]])) and not lens.contains(torch.tensor([[0.0], [0.6 * RADIUS]]))


def test_the_first_row_of_a_mask_is_on_top_and_its_first_column_on_the_left():
    image = np.array([[1.0, 0.0], [0.0, 0.25]], np.float32)
    x, y = lens_of(Aperture(image=image)).sample(uniform_numbers(DRAWS, 3)).double().mean(1) / RADIUS
    assert (float(x), float(y)) == pytest.approx((-0.3, 0.3), abs=0.005)


def test_a_mask_shows_no_texels():
    """W is continuous: it changes by less than 3 % of its peak over 1 % of a texel's width."""
    lens = lens_of(Aperture(image=MASK))
    x = torch.linspace(-1.1 * RADIUS, 1.1 * RADIUS, 2201)
    values = torch.stack([lens.transmission(torch.stack((x, torch.full_like(x, y)))) for y in torch.linspace(-0.1, 0.1, 50)])
    step = 0.001 * 1.1 * 20 / 2
    assert values.diff(dim=1).abs().max() < 1.1 * step * values.max()


CUTS = {
    "round": Aperture(cat_eye=1.0),
    "strongest": Aperture(cat_eye=1.5, edge=0.5),
    "iris": Aperture(blades=3, rotation=20.0, curvature=0.3, ratio=0.7, cat_eye=0.8),
    "mask": Aperture(image=MASK, rotation=-40.0, cat_eye=0.6),
}


@pytest.mark.parametrize("shape", CUTS.values(), ids=CUTS.keys())
def test_a_cat_s_eye_cuts_the_outer_side_by_a_second_disc(shape):
    """As large as the shape's circle, squeezed with it, and moved towards the middle of the frame."""
    lens = lens_of(shape)
    points = lens.radius * (2.0 * uniform_numbers(DRAWS, 9) - 1.0)
    passes = lens.contains(points).numpy()
    size = lens.radius / max(1.0, 1.0 / shape.ratio)
    for x, y in [(0.0, 0.0), (0.5, 0.2), (-0.3, 0.9), (0.8, -0.6), (0.0, -1.0)]:
        across, along = points[0].numpy() * shape.ratio + shape.cat_eye * size * x, points[1].numpy() + shape.cat_eye * size * y
        expected = np.hypot(across, along) <= size
        focus = torch.tensor([[x * CORNER * FOCUS], [y * CORNER * FOCUS], [FOCUS]])
        left = lens.unblocked(points, focus).numpy()
        assert ((left == expected) | ~passes).mean() > 1.0 - 1e-4
        share = left[passes].mean()
        assert share > 0.999 if x == y == 0.0 else 0.0 < share < 1.0
        if x == 0.0 and y == -1.0 and shape == CUTS["round"]:
            assert share == pytest.approx(2.0 / 3.0 - math.sqrt(3.0) / (2.0 * math.pi), abs=0.01)


def test_nothing_is_cut_without_a_cat_s_eye():
    for shape in (None, Aperture(blades=5)):
        lens = lens_of(shape)
        assert not lens.vignettes and (lens.unblocked(torch.full((2, 4), 1e9), torch.ones(3, 4)) == 1.0).all()


def test_the_round_lens_draws_what_it_always_drew(monkeypatch):
    """Renders by PyTorch must not change by a bit; the native core rounds differently."""
    uniforms = uniform_numbers(1000, 4)
    expected = (
        RADIUS
        * (1.0 - 1e-6)
        * uniforms[0].sqrt()
        * torch.stack(((2.0 * math.pi * uniforms[1]).cos(), (2.0 * math.pi * uniforms[1]).sin()))
    )
    lens = lens_of(None)
    torch.testing.assert_close(lens.sample(uniforms), expected, rtol=1e-6, atol=1e-6 * RADIUS)
    monkeypatch.setenv(native.SWITCH, "0")
    assert type(lens) is Lens and torch.equal(lens.sample(uniforms), expected)
    points = 2.0 * expected
    assert torch.equal(lens.transmission(points) == 1.0, points.square().sum(0) <= RADIUS**2)
    assert torch.equal(lens.transmission(points) > 0.0, lens.contains(points))
    assert type(lens_of(Aperture(blades=5), radius=0.0)) is Lens


def guided(lens: Lens, count: int) -> GaussianMixture:
    """Two Gaussians, one of them at the rim, and the lens's own density, for one pixel and many draws."""
    mean = torch.tensor([[0.01, -0.12], [0.02, 0.04], [1.2, 5.0]])
    return GaussianMixture(
        lens,
        torch.tensor([[0.05], [0.1], [FOCUS]]).expand(3, count).contiguous(),
        torch.full((count,), 0.5),
        2 * torch.arange(count + 1),
        mean.repeat(1, count),
        torch.tensor([0.02, 0.04]).repeat(count),
        torch.tensor([1.0, 2.0]).repeat(count),
    )


@pytest.mark.parametrize("name", ["pentagon, turned", "lying", "bright rim", "mask"])
def test_mixtures_follow_their_density(name):
    lens, extent = lens_of(SHAPES[name]), 0.16
    points, area = square_grid(extent)
    density = torch.cat([guided(lens, part.shape[1]).pdf(part) for part in points.float().split(1 << 18, 1)])
    probability = cell_integrals(density, area)
    observed = counts(guided(lens, DRAWS).sample(uniform_numbers(DRAWS, 6, 5)).points, extent)
    assert 0.8 < probability.sum() < 0.99
    assert chi_square(observed, np.append(probability, 1.0 - probability.sum())) > SIGNIFICANCE


def test_blend_gradient_knows_the_uniform_part():
    """Against automatic differentiation of -ratio log q in β's logit."""
    lens = lens_of(SHAPES["lying"])
    mixture = guided(lens, 1000)
    at = mixture.evaluate(mixture.sample(uniform_numbers(1000, 7, 5)).points)
    ratio = lens.transmission(at.points) / (lens.area * at.density)
    logit = torch.logit((mixture.beta - 0.05) / 0.9).requires_grad_()
    beta = 0.05 + 0.9 * torch.sigmoid(logit)
    density = beta * at.mixture + (1.0 - beta) * lens.transmission(at.points) / lens.area
    (-ratio * density.clamp(min=1e-20).log()).sum().backward()
    torch.testing.assert_close(blend_gradient(mixture, ratio, at), logit.grad, rtol=1e-4, atol=1e-6)


def even(self, uniforms: torch.Tensor) -> torch.Tensor:
    """The numbers of a sector's area, whatever its transmission."""
    return uniforms


@pytest.mark.parametrize("name", ["square", "lying", "bright rim"])
def test_draws_that_forget_the_transmission_fail(name, monkeypatch):
    lens = lens_of(SHAPES[name])
    monkeypatch.setattr(type(lens.pupil), "_share", even)
    assert draws_check(lens) < SIGNIFICANCE


def test_draws_that_take_the_arc_for_its_area_fail(monkeypatch):
    lens = lens_of(SHAPES["arcs"])
    monkeypatch.setattr(type(lens.pupil), "_arc_length", lambda self, share: share * self._end)
    assert draws_check(lens) < SIGNIFICANCE
