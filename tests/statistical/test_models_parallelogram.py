"""ParallelogramEmitters on the lens: draws against the density, the density against 1, plain geometry and finite differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy import stats

from bokehguide.models.emitters.parallelogram import ParallelogramEmitters, ViewedParallelograms
from bokehguide.models.projection import FAR_OUTSIDE, LENS_MARGIN
from tests.support.lens_cases import LENS, PolarGrid, histogram_check
from tests.support.statistical import SIGNIFICANCE, sidak

RADIUS = torch.tensor(LENS.radius)
DRAWS = 100_000
X_F, NEARER_X_F, FAR_X_F = (0.3, -0.2, 2.0), (0.05, -0.1, 2.0), (1.8e11, -1.2e11, 1e12)
Point = tuple[float, float, float]
WHOLE = 1.002 * LENS.radius
"""Reach of a grid that holds all that is drawn of a parallelogram which is larger than the lens."""


@dataclass(frozen=True)
class ParallelogramCase:
    """A parallelogram by its middle and half edges, seen through a focus point.

    reach, middle: of the lens plane that shows what is drawn of it, metres. fine: nodes across each cell, as the density
    jumps at the parallelogram's edges.
    """

    name: str
    centre: Point
    right: Point
    up: Point
    reach: float
    middle: tuple[float, float] = (0.0, 0.0)
    focus: Point = X_F
    fine: int = 80

    def parallelograms(self) -> ParallelogramEmitters:
        """Second of two parallelograms: the first is never seen."""
        other = torch.tensor(((0.0, 0.0, 9.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0)))
        parts = torch.tensor((self.centre, self.right, self.up))
        return ParallelogramEmitters(*torch.stack((other, parts), dim=2))

    def seen(self, count: int) -> ViewedParallelograms:
        focus = torch.tensor(self.focus)[:, None].expand(3, count)
        return ViewedParallelograms(
            self.parallelograms(), torch.ones(count, dtype=torch.int64), torch.arange(count), focus, RADIUS
        )

    def window(self) -> np.ndarray:
        """Low and high coordinates `[2, 2]` of what is drawn."""
        one = self.parallelograms().select(torch.tensor([1]))
        return one.window(torch.tensor(self.focus)[:, None], RADIUS)[:, :, 0].double().numpy()

    def chords(self, across: np.ndarray) -> np.ndarray:
        """Ends `[2, N]` of the visible interval of the second coordinate at first coordinates `[N]`, in double precision.

        Lens points are quotients of linear functions of the coordinate, and |(a + b y) / (c + d y)|² ≤ r² is a quadratic
        inequality.
        """
        low, high = self.window()[:, 1]
        focus, up = np.array(self.focus), np.array(self.up)
        start = (np.array(self.centre) + across[:, None] * np.array(self.right)) - focus
        a, b = focus[:2] * start[:, 2:] - focus[2] * start[:, :2], focus[:2] * up[2] - focus[2] * up[:2]
        c, d, squared = start[:, 2], up[2], (LENS_MARGIN * LENS.radius) ** 2
        equations = np.stack(
            ((b @ b - squared * d * d) + 0.0 * c, 2.0 * (a @ b - squared * c * d), (a * a).sum(1) - squared * c * c)
        )
        ends = []
        for equation in equations.T:
            edges = [root.real for root in np.roots(equation) if abs(root.imag) < 1e-12 and low < root.real < high]
            edges = np.array(sorted([low, *edges, high]))
            inside = np.polyval(equation, 0.5 * (edges[1:] + edges[:-1])) <= 0.0
            ends.append((edges[:-1][inside].min(), edges[1:][inside].max()) if inside.any() else (low, low))
        return np.array(ends).T

    def cells(self) -> PolarGrid:
        return PolarGrid(self.reach * np.sqrt(np.linspace(0.0, 1.0, 9)), 16, self.middle)

    def draw(self, count: int, seed: int) -> torch.Tensor:
        bits = torch.randint(0, 1 << 23, (2, count), generator=torch.Generator().manual_seed(seed))
        return self.seen(count).sample(torch.arange(count), (bits + 0.5) / 2.0**23)

    def pdf(self, points: torch.Tensor) -> torch.Tensor:
        return self.seen(points.shape[1]).pdf(points.float()).double()

    def places(self, points: np.ndarray) -> np.ndarray:
        """Depth and coordinates `[3, N]` at which lines from lens points `[2, N]` through x_F meet the parallelogram."""
        focus, start = np.array(self.focus)[:, None], np.concatenate((points, np.zeros_like(points[:1])))
        edges = np.broadcast_to(np.array((self.right, self.up)).T, (points.shape[1], 3, 2))
        matrix = np.concatenate((((focus - start) / focus[2]).T[:, :, None], -edges), axis=2)
        return np.linalg.solve(matrix, (np.array(self.centre)[:, None] - start).T[..., None])[..., 0].T


CASES = [
    ParallelogramCase("whole in the lens", (0.86, -0.58, 6.0), (0.06, 0.02, 0.01), (-0.01, 0.05, 0.03), 0.05, (0.02, -0.01)),
    ParallelogramCase("before the focus", (0.168, -0.112, 1.2), (0.01, 0.002, 0.004), (0.0, 0.012, -0.003), 0.05, (-0.03, 0.02)),
    ParallelogramCase("clipped", (0.63, -0.575, 5.0), (0.3, 0.05, 0.1), (-0.04, 0.2, 0.1), WHOLE),
    ParallelogramCase("larger than the lens", (0.3, -0.35, 5.0), (2.0, 0.3, 0.5), (-0.4, 1.5, 0.9), WHOLE),
    ParallelogramCase("nearly from the edge", (0.88, -0.64, 6.0), (0.02, 0.15, 0.0), (0.274, -0.132, 1.2), 0.15, (0.03, 0.02)),
    ParallelogramCase("parallel to a ray", (0.35, -0.2, 6.0), (0, 0.2, 0), (0, 0, 2.0), WHOLE, (0.0, 0.0), NEARER_X_F, fine=120),
    ParallelogramCase("side wall", (0.7, -0.4, 7.0), (0.0, 2.0, 0.0), (0.0, 0.0, 4.5), WHOLE, fine=120),
    ParallelogramCase("small", (0.86, -0.58, 6.0), (2e-3, 1e-4, 0.0), (0.0, 1e-3, 5e-4), 1.2e-3, (0.02, -0.01)),
    ParallelogramCase("focus far away", (0.74, -0.48, 4.0), (0.03, 0.0, 0.01), (0.0, 0.02, 0.0), 0.045, (0.02, 0.0), FAR_X_F),
]
"""The last but one is half a millimetre on the lens; the last is seen through a lens that is focused at infinity."""
BY_NAME = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


def probabilities(case: ParallelogramCase) -> np.ndarray:
    points, area = case.cells().nodes(case.fine)
    return (case.pdf(points).numpy().reshape(area.shape) * area).sum(2)


@pytest.mark.slow
@BY_NAME
def test_draws_follow_the_density(case):
    probability = probabilities(case)
    observed = case.cells().count(case.draw(DRAWS, seed=1))
    assert observed[-1] == 0 and histogram_check(observed, probability / probability.sum()) > SIGNIFICANCE


@pytest.mark.slow
@BY_NAME
def test_the_density_integrates_to_one(case):
    assert probabilities(case).sum() == pytest.approx(1.0, abs=2e-3)


@pytest.mark.slow
@BY_NAME
def test_draws_lie_on_the_parallelogram(case):
    """Evenly along it and, at each place, across what the lens sees there, but for a rim against rounding; none that meets it
    has the density 0."""
    points = case.draw(DRAWS // 10, seed=3)
    depth, *places = case.places(points.double().numpy())
    assert (depth > 0.0).all() and max(np.abs(place).max() for place in places) < 1.02
    window, (low, high) = case.window(), case.chords(places[0])
    within = [(places[0] - window[0, 0]) / (window[1, 0] - window[0, 0]), (places[1] - low) / (high - low)]
    assert sidak([stats.kstest(place, "uniform").pvalue for place in within]) > SIGNIFICANCE
    meets = (np.abs(places) <= 1.0).all(0)
    assert (case.pdf(points).numpy()[meets] > 0.0).all()


@BY_NAME
def test_hardly_a_draw_misses_the_lens(case):
    """But for the rim against rounding; even in the parallelogram's coordinates, over all of the lens's square, a third would."""
    assert float((case.draw(DRAWS, seed=7).norm(dim=0) > LENS.radius).float().mean()) < 0.01


@BY_NAME
def test_all_that_the_lens_sees_of_a_parallelogram_is_drawn(case):
    """Lens points that see the parallelogram are those of a density above 0, but for a rim of the parallelogram."""
    points = LENS.sample(torch.rand(2, DRAWS, generator=torch.Generator().manual_seed(4)))
    depth, *places = case.places(points.double().numpy())
    outermost, density = np.abs(places).max(0), case.pdf(points).numpy()
    assert (density[(outermost < 0.999) & (depth > 0.0)] > 0.0).all()
    assert not density[(outermost > 1.02) | (depth < 0.0)].any()


@BY_NAME
def test_the_density_is_one_over_the_stretch(case):
    """From the parallelogram to the lens plane, by central differences in double precision."""
    points, window, step = case.draw(1000, seed=5).double().numpy(), case.window(), 1e-6
    columns = []
    for aside in np.eye(2)[:, :, None] * step:
        columns.append((case.places(points + aside) - case.places(points - aside))[1:] / (2.0 * step))
    (a, b), (c, d) = columns
    area = np.diff(window[:, 0]) * np.diff(case.chords(case.places(points)[1]), axis=0)[0]
    inside = np.hypot(*points) < LENS.radius
    density, expected = case.pdf(torch.from_numpy(points)).numpy()[inside], (np.abs(a * d - b * c) / area)[inside]
    np.testing.assert_allclose(density[density > 0.0], expected[density > 0.0], rtol=2e-3)
    assert (density > 0.0).mean() > 0.8


@BY_NAME
def test_how_large_it_looks(case):
    """On average over the draws, one over the density is the area of the lens plane that they cover: half of it to twice."""
    density = case.pdf(case.draw(DRAWS, seed=6)).numpy()
    assert 0.5 < float(case.seen(1).area) / (1.0 / density[density > 0.0]).mean() < 2.0


BESIDE = ((0.0, 0.5, 0.0), (0.0, 0.0, 1.0))  # half edges of a wall along the axis
UNSEEN = [
    ParallelogramCase("beside the lens", (3.0, -0.2, 6.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), 0.1),
    ParallelogramCase("x_F in its plane", (0.3, -0.2, 6.0), *BESIDE, 0.1),
    ParallelogramCase("x_F in its plane, before the lens", (0.05, -0.2, 6.0), *BESIDE, 0.1, focus=(0.05, -0.2, 2.0)),
    ParallelogramCase(
        "x_F in its slanting plane", (0.3, -0.2, 6.0), (0.0, 0.5, 0.0), (0.1, 0.0, 1.0), 0.1, focus=(-0.1, -0.2, 2.0)
    ),
]


@pytest.mark.parametrize("case", UNSEEN, ids=lambda case: case.name)
def test_what_cannot_be_seen_has_no_density(case):
    """Nor a size, at any lens point, those in the parallelogram's plane included."""
    line = torch.linspace(-0.1, 0.1, 401)
    x, y = (torch.cat(parts) for parts in ((line, torch.full_like(line, case.focus[0])), (0.1 * line, line)))
    assert float(case.seen(1).area) == 0.0
    assert torch.equal(case.pdf(torch.stack((x, y))), torch.zeros(802, dtype=torch.float64))


def test_samples_of_a_parallelogram_beside_the_lens_are_far_outside():
    assert (UNSEEN[0].draw(1000, seed=2) == FAR_OUTSIDE).all()


def test_a_ray_along_a_parallelogram_does_not_meet_it():
    """The lens point beside the parallelogram by as much as x_F."""
    case = ParallelogramCase("wall", (0.1, -0.2, 6.0), *BESIDE, 0.1, focus=(0.05, -0.2, 2.0))
    density = case.pdf(torch.tensor([[0.05, 0.05, 0.025], [0.0, 0.05, 0.0]]))
    assert (density[:2] == 0.0).all() and 0.0 < float(density[2]) < 1e6


@pytest.mark.slow
def test_a_wrong_density_fails(monkeypatch):
    right = ParallelogramEmitters.pdf
    monkeypatch.setattr(ParallelogramEmitters, "pdf", lambda self, *arguments: 1.02 * right(self, *arguments))
    for check in (test_the_density_integrates_to_one, test_the_density_is_one_over_the_stretch):
        with pytest.raises(AssertionError):
            check(CASES[0])


@pytest.mark.slow
def test_a_wrong_shape_fails(monkeypatch):
    """Even over the lens plane and not over the parallelogram."""
    monkeypatch.setattr(ParallelogramEmitters, "pdf", lambda self, points, *seen: 1.0 / self.area_on_lens(*seen))
    with pytest.raises(AssertionError):
        test_draws_follow_the_density(next(case for case in CASES if case.name == "side wall"))
