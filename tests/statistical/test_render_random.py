"""The keyed random numbers: uniform, independent, and the same whatever is rendered beside them."""

import numpy as np
import pytest
import torch

from bokehguide.render.random import PixelRandom, hash_int, hash_tensor
from tests.support.statistical import SIGNIFICANCE, independence, uniformity, z_test

PIXELS = 1 << 18


def draw(dimension: int, seed: int = 0, step: int = 1, pixels: torch.Tensor | None = None) -> np.ndarray:
    """One number for each pixel, by default of the first PIXELS."""
    pixels = torch.arange(PIXELS) if pixels is None else pixels
    return PixelRandom(seed, step, pixels).uniform(dimension, 1)[0].numpy()


def over_steps(pixels: int, steps: int, dimensions: int) -> np.ndarray:
    """`[steps, dimensions, pixels]`."""
    index = torch.arange(pixels)
    return np.stack([PixelRandom(3, step, index).uniform(0, dimensions).numpy() for step in range(steps)])


@pytest.mark.parametrize("dimension", [0, 1, 2, 6, 32, 33, 47, 48, 120])
def test_uniform_over_pixels(dimension):
    assert uniformity(draw(dimension)) > SIGNIFICANCE


@pytest.mark.parametrize("seed", [-1, 1, 2, 12345, 1 << 40])
def test_uniform_over_pixels_with_any_seed(seed):
    assert uniformity(draw(0, seed=seed)) > SIGNIFICANCE


def test_uniform_over_steps_of_one_pixel():
    numbers = over_steps(1, 4096, 4)
    for dimension in range(4):
        assert uniformity(numbers[:, dimension], bins=64) > SIGNIFICANCE


def test_uniform_over_the_dimensions_of_a_path():
    numbers = PixelRandom(0, 1, torch.arange(1024)).uniform(0, 512).numpy()
    assert uniformity(numbers) > SIGNIFICANCE
    assert uniformity(numbers[:, 5], bins=32) > SIGNIFICANCE


@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (1, 3), (2, 3), (3, 6), (32, 33), (38, 39), (39, 40), (32, 48), (2, 34)])
def test_dimensions_are_pairwise_independent(pair):
    assert independence(draw(pair[0]), draw(pair[1])) > SIGNIFICANCE


@pytest.mark.parametrize("apart", [1, 2, 320, 640, 1024, 1920, 4096])
def test_neighbouring_pixels_are_independent(apart):
    pixels = torch.arange(PIXELS)
    assert independence(draw(2), draw(2, pixels=pixels + apart)) > SIGNIFICANCE
    assert independence(draw(2), draw(3, pixels=pixels + apart)) > SIGNIFICANCE


@pytest.mark.parametrize("apart", [1, 2, 16, 256])
def test_steps_are_independent(apart):
    assert independence(draw(2), draw(2, step=1 + apart)) > SIGNIFICANCE
    assert independence(draw(2), draw(3, step=1 + apart)) > SIGNIFICANCE


def test_the_lens_points_of_one_pixel_are_independent_from_step_to_step():
    numbers = over_steps(16, 4096, 4)
    assert independence(numbers[:, 2], numbers[:, 3], bins=16) > SIGNIFICANCE
    assert independence(numbers[:-1:2, 2], numbers[1::2, 2], bins=16) > SIGNIFICANCE
    assert independence(numbers[:-1:2, 2], numbers[1::2, 3], bins=16) > SIGNIFICANCE
    assert independence(numbers[:, 2, :8], numbers[:, 2, 8:], bins=16) > SIGNIFICANCE


def test_seeds_are_independent():
    assert independence(draw(2, seed=0), draw(2, seed=1)) > SIGNIFICANCE
    assert independence(draw(2, seed=7, step=1), draw(2, seed=8, step=2)) > SIGNIFICANCE


def test_sums_over_dimensions_and_steps_have_the_variance_of_independent_numbers():
    """Correlations too small for a pair of them to show add up in a sum."""
    numbers = PixelRandom(0, 1, torch.arange(1 << 16)).uniform(0, 64).double().sum(0)
    spread = numbers.var() / (64.0 / 12.0) - 1.0
    assert z_test(float(spread), np.sqrt(2.0 / (1 << 16))) > SIGNIFICANCE
    numbers = over_steps(256, 1024, 1).astype(float).sum(0)
    assert z_test(numbers.var(ddof=1) / (1024.0 / 12.0) - 1.0, np.sqrt(2.0 / 256)) > SIGNIFICANCE


def test_other_pixels_and_compaction_change_nothing():
    pixels = torch.arange(1000)
    whole = PixelRandom(5, 9, pixels)
    index = torch.tensor([999, 0, 3, 3, 500])
    expected = whole.uniform(40, 6)[:, index]
    assert torch.equal(whole.select(index).uniform(40, 6), expected)
    assert torch.equal(
        whole.select(torch.arange(0, 1000, 3)).select(torch.tensor([1])).uniform(0, 2), whole.uniform(0, 2)[:, 3:4]
    )
    assert torch.equal(PixelRandom(5, 9, pixels[index]).uniform(40, 6), expected)


def test_dimensions_do_not_depend_on_how_many_are_asked_for():
    random = PixelRandom(5, 9, torch.arange(100))
    assert torch.equal(random.uniform(3, 7)[2:4], random.uniform(5, 2))


def test_never_zero_and_never_one():
    numbers = draw(0, pixels=torch.arange(1 << 24))
    assert numbers.dtype == np.float32
    assert numbers.min() == 2.0**-24  # the smallest and largest values there are do occur
    assert numbers.max() == 1.0 - 2.0**-24


def test_the_hash_of_tensors_is_that_of_integers_and_a_bijection():
    values = torch.arange(-(1 << 19), 1 << 19, dtype=torch.int32)
    hashed = hash_tensor(values.clone())
    assert len(hashed.unique()) == len(values)
    for value in (-(1 << 19), -1, 0, 1, 123456):
        assert int(hashed[value + (1 << 19)]) & 0xFFFFFFFF == hash_int(value)
