"""The choice of emitters by place: a distribution in every cell, and one that favours what is near."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bokehguide.render.lights.clusters import LEVELS
from bokehguide.render.lights.voxel_grid import DEFENSIVE, GridEmitters, LightVoxelGrid
from bokehguide.render.random import PixelRandom
from tests.support.statistical import SIGNIFICANCE, chi_square

DRAWS = 200_000
DOWN = (0.0, -1.0, 0.0)


def grid_of(centers, normals, power, double_sided=False, axis=(0.0, 0.0, 0.0), outer=np.pi) -> LightVoxelGrid:
    """A grid of emitters; what is given once holds for all."""
    centers = np.asarray(centers, np.float32)
    count = len(centers)
    normals, axis = (np.broadcast_to(np.asarray(v, np.float32), (count, 3)) for v in (normals, axis))
    power, double_sided, outer = (np.broadcast_to(np.asarray(v), count) for v in (power, double_sided, outer))
    emitters = GridEmitters(centers, normals, power.astype(np.float32), double_sided, axis, outer)
    return LightVoxelGrid(emitters, torch.device("cpu"))


def crowd(count: int = 400) -> LightVoxelGrid:
    """Emitters of all directions and of powers over many decades, a twentieth of them in one place."""
    generator = np.random.default_rng(8)
    centers = generator.uniform(-1.0, 1.0, (count, 3)) * (4.0, 1.0, 2.0)
    centers[: count // 20] = (1.0, 0.5, -0.3)
    normals = generator.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return grid_of(centers, normals, generator.lognormal(0.0, 3.0, count), generator.uniform(size=count) < 0.3)


def points(*places) -> Tensor:
    """`[3, N]` of N places."""
    return torch.from_numpy(np.array(places, np.float32).T.copy())


PLACES = [(0.0, 0.0, 0.0), (1.0, 0.5, -0.3), (-3.9, 0.9, 1.9), (1e3, -40.0, 7.0), (-1e30, 0.0, 1e30)]


def drawn_from(grid: LightVoxelGrid, cells: torch.Tensor, uniforms: torch.Tensor) -> torch.Tensor:
    """Emitters `[N]`, in the order in which they were given, from uniform numbers `[3, N]`."""
    return torch.from_numpy(grid.order)[grid.sample_within(grid.sample_cluster(cells, uniforms[0]), uniforms[1:3])]


def density(grid: LightVoxelGrid, cells: torch.Tensor, emitters: torch.Tensor) -> torch.Tensor:
    """Probability `[N]` of each emitter in each cell."""
    number = torch.from_numpy(grid.order).argsort()[emitters]
    return grid.table.pdf(cells, grid.cluster(number)) * grid.pdf_within(number)


def choice(grid: LightVoxelGrid, place, count: int) -> np.ndarray:
    """Probabilities of all `count` emitters at one point, float64."""
    return density(grid, grid.cells(points(place)).expand(count), torch.arange(count)).double().numpy()


@pytest.mark.parametrize("place", PLACES)
def test_draws_follow_the_pdf(place):
    grid = crowd()
    uniforms = PixelRandom(4, 0, torch.arange(DRAWS)).uniform(0, 3)
    drawn = drawn_from(grid, grid.cells(points(place)).expand(DRAWS), uniforms)
    assert chi_square(np.bincount(drawn.numpy(), minlength=400), choice(grid, place, 400)) > SIGNIFICANCE


def test_the_pdf_sums_to_one_in_every_cell():
    grid = crowd()
    cells = torch.arange(len(grid.light))
    total = sum(density(grid, cells, torch.full_like(cells, emitter)).double() for emitter in range(400))
    torch.testing.assert_close(total, torch.ones_like(total), rtol=0.0, atol=1e-5)


def test_lamps_of_a_row_are_told_apart_to_about_a_cell():
    """All alike, one a cell and more: where each hangs, it or its neighbour is the likeliest."""
    centers = np.linspace((-10.0, 0.0, 0.0), (10.0, 0.0, 0.0), 20)
    grid = grid_of(centers, DOWN, 1.0)
    for emitter, center in enumerate(centers):
        assert abs(int(choice(grid, center - (0.0, 0.3, 0.0), 20).argmax()) - emitter) <= 1


def test_the_bisection_is_a_search_in_the_cumulative_sums():
    """Also at the sums themselves, where the next cluster begins."""
    grid = crowd()
    sums = grid.table.cumulative.reshape(-1, 2**LEVELS)
    cells = grid.cells(points(*PLACES)).repeat_interleave(5000)
    u = PixelRandom(5, 0, torch.arange(len(cells))).uniform(0, 3)
    u[0, ::5] = sums[cells[::5], torch.arange(len(cells) // 5) % (2**LEVELS - 1)].clamp(max=1.0 - 2.0**-24)
    cluster = grid.cluster(grid.sample_within(grid.sample_cluster(cells, u[0]), u[1:3]))
    expected = torch.searchsorted(sums[cells], u[0, :, None], right=True)[:, 0]
    assert torch.equal(cluster, expected)
    assert len(cluster.unique()) > 100


def test_points_outside_belong_to_the_nearest_cell():
    grid = crowd()
    for axis in range(3):
        for sign in (-1.0, 1.0):
            inside, beyond, far = (np.array([0.3, 0.2, -0.1]) for _ in range(3))
            beyond[axis], far[axis] = 10.0 * sign, 1e30 * sign
            cells = grid.cells(points(inside, beyond, far))
            assert cells[0] != cells[1] and cells[1] == cells[2]
    assert len(grid.cells(torch.randn(3, 10_000) * 100.0).unique()) > 8


@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (3.0, -4.0, 5.0), (100.0, 100.0, 100.0), (1e4, 0.0, -1e4)])
def test_a_single_triangle_is_always_chosen(center):
    grid = grid_of([center], DOWN, 2.5)
    cells = grid.cells(points(*PLACES, center))
    uniforms = PixelRandom(6, 0, torch.arange(len(cells))).uniform(0, 3)
    assert not drawn_from(grid, cells, uniforms).any()
    assert (density(grid, cells, torch.zeros_like(cells)) == 1.0).all()


def test_thousands_of_lamps_in_one_place_are_chosen_alike():
    grid = grid_of(np.full((5000, 3), 0.7), DOWN, 1e-3)
    for place in PLACES:
        np.testing.assert_allclose(choice(grid, place, 5000), 1.0 / 5000, rtol=1e-5)
    drawn = drawn_from(grid, grid.cells(points(PLACES[0])).expand(DRAWS), PixelRandom(7, 0, torch.arange(DRAWS)).uniform(0, 3))
    assert chi_square(np.bincount(drawn.numpy(), minlength=5000), np.full(5000, 1.0 / 5000)) > SIGNIFICANCE


def test_of_thousands_of_equal_lamps_the_nearest_are_preferred():
    """A ceiling of 100 × 100: below one corner its own quarter gets nearly all that does not go by power."""
    x, z = np.meshgrid(np.linspace(0.0, 20.0, 100), np.linspace(0.0, 20.0, 100))
    grid = grid_of(np.stack((x.ravel(), np.zeros(10_000), z.ravel()), axis=1), DOWN, 1.0)
    p = choice(grid, (1.0, -1.0, 1.0), 10_000)
    near = (x.ravel() < 10.0) & (z.ravel() < 10.0)
    assert p[near].sum() > 1.0 - DEFENSIVE
    assert p.min() == pytest.approx(DEFENSIVE / 10_000, rel=0.5)


def test_a_near_dim_lamp_is_chosen_more_than_a_far_bright_one():
    grid = grid_of([(0.0, 1.0, 0.0), (10.0, 1.0, 0.0)], DOWN, [1.0, 20.0])
    near = choice(grid, (0.0, 0.0, 0.0), 2)
    assert near[0] > 2.0 * near[1]
    assert near[1] > DEFENSIVE * 20.0 / 21.0
    far = choice(grid, (10.0, 0.0, 0.0), 2)
    assert far[1] > 0.95 and far[0] == pytest.approx(DEFENSIVE / 21.0, rel=0.1)


def test_a_lamp_that_faces_away_is_left_to_the_choice_by_power():
    towards_and_away = [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0)]
    centers = [(-4.0, 4.0, 0.0), (4.0, 4.0, 0.0)]
    assert choice(grid_of(centers, towards_and_away, 1.0), (0.0, 0.0, 0.0), 2)[1] == pytest.approx(0.5 * DEFENSIVE)


@pytest.mark.parametrize("x", [0.3, 2.3])
def test_a_double_sided_lamp_is_chosen_as_much_from_behind(x):
    """Where the two have changed places, each is chosen as much as the other was."""
    grid = grid_of([(-4.0, 4.0, 0.0), (4.0, 4.0, 0.0)], [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0)], 1.0, double_sided=True)
    left, right = choice(grid, (-x, 0.0, 0.0), 2), choice(grid, (x, 0.0, 0.0), 2)
    np.testing.assert_allclose(left, right[::-1], rtol=0.15)


@pytest.mark.parametrize("height", [2.0, 3.0])
def test_the_light_of_a_cell_is_power_over_squared_distance(height):
    """Under a hundred square metres of emitters seen from a few cells away, summed in full."""
    x, z = (side.ravel() for side in np.meshgrid(np.linspace(-5.0, 5.0, 60), np.linspace(-5.0, 5.0, 60)))
    centers = np.stack((x, np.zeros_like(x), z), axis=1)
    grid = grid_of(centers, DOWN, 0.1)
    squared = x**2 + height**2 + z**2
    expected = (0.1 * height / squared**1.5).sum()
    found = float(grid.light[grid.cells(points((0.0, -height, 0.0)))])
    assert found == pytest.approx(expected, rel=0.3)


def test_direct_light_near_one_of_many_lamps_is_far_less_noisy_than_by_power():
    """The variance of a one-emitter estimate of irradiance on a wall 10 cm from a dim emitter, in closed form.

    200 emitters over 6 m, one in ten of them a hundred times as bright as the rest.
    """
    generator = np.random.default_rng(9)
    centers = generator.uniform(-3.0, 3.0, (200, 3))
    power = np.where(np.arange(200) % 10 == 0, 100.0, 1.0)
    centers[5] = (0.0, 0.0, 0.0)
    grid = grid_of(centers, (-1.0, 0.0, 0.0), power, double_sided=True)
    guided = by_power = 0.0
    for place in generator.uniform((-0.1, -0.1, -0.1), (-0.1, 0.1, 0.1), (50, 3)):
        offset = centers - place
        squared = np.square(offset).sum(axis=1)
        irradiance = power * np.maximum(offset[:, 0], 0.0) * np.abs(offset[:, 0]) / squared**2
        guided += (irradiance**2 / choice(grid, place, 200)).sum() - irradiance.sum() ** 2
        by_power += (irradiance**2 * power.sum() / power).sum() - irradiance.sum() ** 2
    assert 0.0 < guided < 0.1 * by_power


def test_spotlights_are_left_to_the_places_in_their_cones():
    """A spotlight that looks down and one that looks aside, from one place, with a dim emitter beside them."""
    centers = [(0.0, 4.0, 0.0), (0.0, 4.0, 0.0), (4.0, 0.0, 0.0)]
    axes = [DOWN, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    outer = np.array([0.3, 0.3, np.pi])
    grid = grid_of(centers, [DOWN, (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)], [1e4, 1e4, 1.0], False, axes, outer)
    by_power = DEFENSIVE * np.array([1e4, 1e4, 1.0]) / 20001.0
    for place, lit in (((0.0, 0.5, 0.0), 0), ((3.0, 4.0, 0.0), 1), ((3.0, 0.5, 0.0), 2)):
        found = choice(grid, place, 3)
        assert found[lit] > 0.8, place
        for dark in {0, 1} - {lit}:
            assert found[dark] == pytest.approx(by_power[dark], rel=1e-4), place
    dark, lit = grid.light[grid.cells(points((3.0, 0.5, 0.0), (0.0, 0.5, 0.0)))]
    assert lit > 100.0 * dark


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cells_at_every_side_also_stand_for_the_space_beyond(axis, sign):
    """A spotlight whose narrow cone leaves the grid and passes by the nearest cell of a far point: chosen as without the cone."""
    direction = np.zeros(3)
    direction[axis], direction[(axis + 1) % 3] = sign, 0.6 * sign
    direction /= np.linalg.norm(direction)
    centers = [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (-1.0, -1.0, -1.0)]
    normals = [direction, DOWN, DOWN]
    power, axes = [1e4, 1.0, 1.0], [direction, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    spot = grid_of(centers, normals, power, False, axes, np.array([0.02, np.pi, np.pi]))
    free = grid_of(centers, normals, power)
    assert choice(spot, 100.0 * direction, 3)[0] > 0.9
    np.testing.assert_allclose(choice(spot, 100.0 * direction, 3), choice(free, 100.0 * direction, 3), rtol=1e-5)
