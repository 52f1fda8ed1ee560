"""Balls, emitters of the map and parallelograms in one mixture: draws against the density, the density against 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from bokehguide.models.ellipse_mixture import EmitterShapes
from bokehguide.models.emitters.environment import EnvironmentEmitters, ViewedEnvironment
from bokehguide.models.emitters.parallelogram import ParallelogramEmitters, ViewedParallelograms
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.types import Camera
from tests.support.lens_cases import X_F, EllipseCase, grid, in_both_forms, mean_through, means_of, probabilities
from tests.support.statistical import SIGNIFICANCE, chi_square

DRAWS = 100_000
HEIGHT = 256


def environment() -> EnvironmentEmitters:
    """Two emitters of a map, of four uneven texels each: the second is seen through X_F from the middle of the lens."""
    luminance, emitter = np.zeros((HEIGHT, 2 * HEIGHT)), np.full((HEIGHT, 2 * HEIGHT), -1)
    for number, column in enumerate((100, 267)):
        luminance[135:137, column : column + 2] = ((1.0, 4.0), (2.0, 2.0))
        emitter[135:137, column : column + 2] = number
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), aperture_radius=0.1, focus_distance=2.0)
    return EnvironmentEmitters(luminance, emitter, 0.0, ThinLensCamera(camera, 64, 36))


def parallelograms() -> ParallelogramEmitters:
    """One clipped by the lens, one within it."""
    return ParallelogramEmitters(
        torch.tensor(((1.2, 0.795), (-0.4, -0.545), (7.0, 5.0))),
        torch.tensor(((0.5, 0.1), (0.0, 0.02), (0.3, 0.1))),
        torch.tensor(((0.0, -0.03), (0.4, 0.12), (0.1, 0.0))),
    )


@dataclass(frozen=True)
class ShapesCase(EllipseCase):
    """As a EllipseCase; environment_index, parallelogram_index: which of them each candidate is, -1 for none."""

    environment_index: tuple[int, ...] = ()
    parallelogram_index: tuple[int, ...] = ()

    def shapes(self, count: int) -> EmitterShapes:
        environment_index, parallelogram_index = (
            torch.tensor(numbers).repeat(count) for numbers in (self.environment_index, self.parallelogram_index)
        )
        return EmitterShapes(environment(), environment_index, parallelograms(), parallelogram_index, torch.tensor((3.0, 8.0)))


BALL, FAR_AWAY, WALL = mean_through(0.05, -0.04, 1.3), mean_through(0.0, 0.0, 2e6), mean_through(-0.03, 0.03, 5.0)
OF_MAP = ShapesCase("emitter of the map", X_F, 1.0, FAR_AWAY, [1e5], [1.0], environment_index=(1,), parallelogram_index=(-1,))
PARALLELOGRAM = ShapesCase("parallelogram", X_F, 0.8, WALL, [0.2], [1.0], environment_index=(-1,), parallelogram_index=(1,))
ALL = ShapesCase(
    "all",
    X_F,
    0.9,
    means_of(BALL, FAR_AWAY, WALL),
    [0.02, 1e5, 0.2],
    [0.01, 0.02, 1.0],
    environment_index=(-1, 1, -1),
    parallelogram_index=(-1, -1, 1),
)
LEARNT = ShapesCase(
    "all, with learned scales",
    X_F,
    0.9,
    means_of(WALL, BALL, FAR_AWAY, WALL),
    [0.2, 0.02, 1e5, 0.3],
    [1.0, 0.01, 0.02, 1.0],
    learned_scale=(0.5, 2.0, 0.3, 1.0),
    environment_index=(-1, -1, 1, -1),
    parallelogram_index=(0, -1, -1, 1),
)
BY_NAME = pytest.mark.parametrize("case", in_both_forms((OF_MAP, PARALLELOGRAM, ALL, LEARNT)), ids=lambda case: case.name)


@pytest.mark.slow
@BY_NAME
def test_draws_follow_the_density(case):
    cells = grid(case)
    probability = probabilities(case, cells)
    observed = cells.count(case.draw(DRAWS, seed=1))
    assert observed[-1] == 0  # nothing reaches beyond the grid
    assert chi_square(observed[:-1], probability.ravel() / probability.sum()) > SIGNIFICANCE


@pytest.mark.slow
@BY_NAME
def test_the_density_integrates_to_one(case):
    assert probabilities(case, grid(case)).sum() == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("case", [PARALLELOGRAM, LEARNT], ids=lambda case: case.name)
def test_candidates_are_drawn_by_their_weights(case):
    """And the mixture tells from which each pixel's draw is; -1 for a uniform one."""
    distribution = case.distribution(DRAWS)
    drawn = distribution.sample(torch.rand(3, DRAWS, generator=torch.Generator().manual_seed(2))).candidate
    candidates = len(case.sigma)
    guided = drawn >= 0
    assert torch.equal(distribution.owner[drawn[guided]], guided.nonzero()[:, 0])
    counts = np.bincount(np.where(guided, drawn % candidates, candidates), minlength=candidates + 1)
    share = case.beta * distribution.weight[:candidates].double().numpy()
    assert chi_square(counts, np.append(share, 1.0 - share.sum())) > SIGNIFICANCE


def test_what_is_learnt_multiplies_the_weights():
    """By which candidates were drawn; how bright they are stays the same."""
    learnt = LEARNT.distribution(1)
    plain = replace(LEARNT, learned_scale=()).distribution(1)
    expected = plain.weight * torch.tensor(LEARNT.learned_scale)
    torch.testing.assert_close(learnt.weight, expected / expected.sum())
    assert torch.equal(learnt.expected_contribution, plain.expected_contribution)


def test_a_parallelogram_counts_by_the_light_it_sends():
    """Its luminance times the area of the lens plane that shows it over π, as a ball does by its disc's."""
    density = PARALLELOGRAM.distribution(DRAWS).component_pdf(PARALLELOGRAM.draw(DRAWS, seed=3))
    area = float((1.0 / density[density > 0.0]).mean())
    assert float(PARALLELOGRAM.distribution(1).expected_contribution) == pytest.approx(8.0 * area / np.pi, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("part", [ViewedParallelograms, ViewedEnvironment])
def test_a_wrong_density_of_one_shape_fails(part, monkeypatch):
    right = part.pdf
    monkeypatch.setattr(part, "pdf", lambda self, points: 1.2 * right(self, points))
    assert abs(probabilities(ALL, grid(ALL)).sum() - 1.0) > 2e-3
