"""The environment map: where it lies, how it is read, and how it is sampled."""

import math

import numpy as np
import pytest
import torch

from bokehguide.render.lights.environment import EnvironmentMap
from bokehguide.render.random import PixelRandom
from bokehguide.scene.types import Environment
from tests.support.sphere import SphereGrid
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test

HEIGHT, WIDTH = 16, 32


def peaked_map() -> np.ndarray:
    """A dim half, a black half, a small sun, a lone blue texel among the black ones, and a bright pole."""
    radiance = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    radiance[:, : WIDTH // 2] = np.random.default_rng(1).uniform(0.1, 1.0, (HEIGHT, WIDTH // 2, 3))
    radiance[4, 7] = (900.0, 800.0, 600.0)
    radiance[10, 25] = (0.0, 0.0, 2.0)
    radiance[0, 20] = 30.0
    return radiance


def uniforms(count: int, seed: int = 0) -> torch.Tensor:
    return PixelRandom(seed, 0, torch.arange(count)).uniform(0, 4)


def map_direction(u: float, v: float, rotation: float = 0.0) -> np.ndarray:
    """Where the map's point (u, v) lies: centre at -z, u towards +x, then turned about +y."""
    azimuth, polar = 2.0 * math.pi * (u - 0.5), math.pi * v
    x, y, z = math.sin(polar) * math.sin(azimuth), math.cos(polar), -math.sin(polar) * math.cos(azimuth)
    turn = math.radians(rotation)
    return np.array([x * math.cos(turn) + z * math.sin(turn), y, z * math.cos(turn) - x * math.sin(turn)])


def cells(factor: int, rotation: float) -> tuple[torch.Tensor, np.ndarray]:
    """Centres `[3, N]` of a grid `factor` times as fine as the texels, and their solid angles `[N]`."""
    rows, columns = HEIGHT * factor, WIDTH * factor
    points = [map_direction((c + 0.5) / columns, (r + 0.5) / rows, rotation) for r in range(rows) for c in range(columns)]
    edges = np.cos(np.pi * np.arange(rows + 1) / rows)
    solid_angle = np.repeat((edges[:-1] - edges[1:]) * 2.0 * np.pi / columns, columns)
    return torch.tensor(np.array(points).T, dtype=torch.float32), solid_angle


def histogram(directions: torch.Tensor, factor: int, rotation: float) -> np.ndarray:
    """Counts of directions in the grid of `cells`."""
    x, y, z = directions.double().numpy()
    turn = math.radians(rotation)
    x, z = x * math.cos(turn) - z * math.sin(turn), z * math.cos(turn) + x * math.sin(turn)
    column = ((0.5 + np.arctan2(x, -z) / (2.0 * np.pi)) % 1.0 * WIDTH * factor).astype(int) % (WIDTH * factor)
    row = (np.arccos(y.clip(-1.0, 1.0)) / np.pi * HEIGHT * factor).astype(int).clip(0, HEIGHT * factor - 1)
    return np.bincount(row * WIDTH * factor + column, minlength=HEIGHT * WIDTH * factor**2)


@pytest.mark.slow
@pytest.mark.parametrize("rotation", [0.0, 37.0, -200.0])
def test_draws_follow_the_density(rotation):
    light = EnvironmentMap(Environment(peaked_map(), rotation))
    directions, pdf = light.sample(uniforms(1_000_000))
    assert torch.allclose(directions.norm(dim=0), torch.ones(()), atol=1e-5)
    assert (pdf > 0.0).all()
    centres, solid_angle = cells(2, rotation)
    probability = light.pdf(centres).double().numpy() * solid_angle
    assert probability.sum() == pytest.approx(1.0, abs=1e-5)
    assert chi_square(histogram(directions, 2, rotation), probability / probability.sum()) > SIGNIFICANCE


def test_the_density_given_with_a_draw_is_the_one_looked_up():
    light = EnvironmentMap(Environment(peaked_map(), 37.0))
    directions, pdf = light.sample(uniforms(100_000))
    apart = (light.pdf(directions) / pdf - 1.0).abs() > 1e-4
    assert apart.float().mean() < 1e-4  # rounding puts a draw across the edge of its texel


@pytest.mark.parametrize("height", [3, 16, 50])
def test_the_poles_lie_in_the_first_and_in_the_last_row(height):
    """The row of the lower pole is the height of the map, or more by rounding."""
    radiance = np.random.default_rng(2).uniform(0.1, 1.0, (height, WIDTH, 3)).astype(np.float32)
    texels = EnvironmentMap(Environment(radiance, 37.0)).texel_at(torch.tensor([[0.0, 0.0], [1.0, -1.0], [0.0, 0.0]]))
    assert (texels // WIDTH).tolist() == [0, height - 1]


def texel_means(light: EnvironmentMap) -> tuple[np.ndarray, float]:
    """Mean luminance of the interpolated map over each texel `[N]`, and over the sphere."""
    centres, _ = cells(16, 0.0)
    red, green, blue = light.radiance(centres).double().numpy().reshape(3, HEIGHT, 16, WIDTH, 16).mean((2, 4))
    mean = (0.2126 * red + 0.7152 * green + 0.0722 * blue).ravel()
    return mean, float(mean @ cells(1, 0.0)[1]) / (4.0 * math.pi)


def test_the_density_is_the_share_of_what_a_texel_exceeds_the_mean_by():
    light = EnvironmentMap(Environment(peaked_map()))
    texels, solid_angle = cells(1, 0.0)
    mean, whole = texel_means(light)
    excess = np.maximum(mean - whole, 0.0)
    assert light.power == pytest.approx(float(excess @ solid_angle), rel=5e-3)
    np.testing.assert_allclose(light.pdf(texels).double().numpy() * light.power, excess, rtol=1e-2, atol=2e-2 * whole)


def test_the_density_is_positive_wherever_there_is_more_light_than_the_mean():
    light = EnvironmentMap(Environment(peaked_map()))
    mean, whole = texel_means(light)
    density = light.pdf(cells(1, 0.0)[0]).numpy()
    assert (density[mean > 1.02 * whole] > 0.0).all()
    assert (density[mean < 0.98 * whole] == 0.0).all()


@pytest.mark.parametrize(
    "u, v, rotation, expected",
    [
        (0.5, 0.5, 0.0, (0, 0, -1)),  # the centre
        (0.75, 0.5, 0.0, (1, 0, 0)),  # u grows towards +x
        (0.25, 0.5, 0.0, (-1, 0, 0)),
        (0.0, 0.5, 0.0, (0, 0, 1)),
        (0.5, 0.0, 0.0, (0, 1, 0)),  # the top row
        (0.5, 1.0, 0.0, (0, -1, 0)),
        (0.5, 0.5, 90.0, (-1, 0, 0)),  # anticlockwise from above: -z turns to -x
        (0.75, 0.5, 90.0, (0, 0, -1)),
        (0.5, 0.5, -30.0, (0.5, 0, -math.sqrt(0.75))),
    ],
)
def test_orientation(u, v, rotation, expected):
    assert np.allclose(map_direction(u, v, rotation), expected, atol=1e-7)  # the tests' own convention
    radiance = np.zeros((64, 128, 3), np.float32)
    columns = np.arange(int(u * 128) - 2, int(u * 128) + 2) % 128
    radiance[max(0, int(v * 64) - 2) : int(v * 64) + 2, columns] = 1.0
    if v in (0.0, 1.0):
        radiance[[0, -1][int(v)]] = 1.0
    light = EnvironmentMap(Environment(radiance, rotation))
    there = torch.tensor(expected, dtype=torch.float32)[:, None]
    assert light.radiance(there)[0].item() == pytest.approx(1.0, abs=1e-4)
    assert light.radiance(-there)[0].item() == 0.0
    directions, _ = light.sample(uniforms(2000))
    assert ((directions * there).sum(0) > 0.95).all()


def test_radiance_is_bilinear_and_wraps_around():
    radiance, rotation = peaked_map(), 37.0
    light = EnvironmentMap(Environment(radiance, rotation))
    points = np.random.default_rng(2).uniform(size=(200, 2))
    points[:8] = [[0.001, 0.5], [0.999, 0.5], [0.3, 0.001], [0.3, 0.999], [0.999, 0.999], [0.0, 0.3], [0.23, 0.28], [0.6, 0.01]]
    directions = np.array([map_direction(u, v, rotation) for u, v in points])
    expected = []
    for u, v in points:
        x, y = u * WIDTH - 0.5, v * HEIGHT - 0.5
        color = np.zeros(3)
        for row in (math.floor(y), math.floor(y) + 1):
            for column in (math.floor(x), math.floor(x) + 1):
                weight = (1 - abs(y - row)) * (1 - abs(x - column))
                color += weight * radiance[min(max(row, 0), HEIGHT - 1), column % WIDTH]
        expected.append(color)
    found = light.radiance(torch.tensor(directions.T, dtype=torch.float32)).T.numpy()
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3)


@pytest.mark.slow
def test_the_weighted_mean_of_draws_is_the_light_of_where_they_fall():
    light = EnvironmentMap(Environment(peaked_map(), 5.625))
    directions, pdf = light.sample(uniforms(200_000, seed=4))
    estimates = (light.radiance(directions) / pdf).double().numpy()
    grid, solid_angle = cells(32, 5.625)
    expected = (light.radiance(grid) * (light.pdf(grid) > 0.0)).double().numpy() @ solid_angle
    error = estimates.std(axis=1) / math.sqrt(200_000) + 1e-3 * expected  # the quadrature's own
    assert z_test(estimates.mean(axis=1) - expected, error) > SIGNIFICANCE


def test_a_constant_map_is_of_one_radiance_and_has_nothing_to_sample():
    for shape in ((1, 1, 3), (4, 8, 3)):
        light = EnvironmentMap(Environment(np.full(shape, 0.7, np.float32)))
        assert torch.allclose(light.radiance(SphereGrid().directions), torch.full((), 0.7))
        assert light.power == 0.0


def test_a_black_map_has_no_power():
    assert EnvironmentMap(Environment(np.zeros((4, 8, 3), np.float32))).power == 0.0
