"""The low-discrepancy numbers of a pixel's steps: even, uniform, independent of all others, and of a measured use."""

import numpy as np
import pytest
import torch

from bokehguide.render import dimensions
from bokehguide.render.random import PixelRandom, shuffle_index, sobol_point
from tests.support.statistical import SIGNIFICANCE, chi_square, independence, sidak, uniformity, z_test

PIXELS = 1 << 17
SEQUENCES = [(0, 2), (32, 1), (33, 4), (37, 6)]
"""Those of a render: film position, and the numbers of the first surface."""


def over_steps(dimension: int, count: int, steps: int, pixels: int = 16, seed: int = 0, first: int = 1) -> np.ndarray:
    """`[steps, count, pixels]`."""
    index = torch.arange(pixels)
    return np.stack([PixelRandom(seed, first + step, index).stratified(dimension, count).numpy() for step in range(steps)])


def at_step(dimension: int, count: int, step: int, seed: int = 0, pixels: torch.Tensor | None = None) -> np.ndarray:
    """`[count, N]`, by default of the first PIXELS."""
    pixels = torch.arange(PIXELS) if pixels is None else pixels
    return PixelRandom(seed, step, pixels).stratified(dimension, count).numpy()


@pytest.mark.parametrize("sequence", [name for name, count in SEQUENCES if count > 1])
@pytest.mark.parametrize("block", [0, 1, 5])
def test_the_first_two_dimensions_of_a_pixel_are_a_0_2_sequence(sequence, block):
    """Each aligned block of 2^m steps has one point in every elementary interval of area 2^-m."""
    for m in range(8):
        x, y = over_steps(sequence, 2, 1 << m, first=1 + (block << m)).transpose(1, 0, 2)
        for across in range(m + 1):
            cell = (x * (1 << across)).astype(int) * (1 << m - across) + (y * (1 << m - across)).astype(int)
            assert (np.sort(cell, axis=0) == np.arange(1 << m)[:, None]).all()


@pytest.mark.parametrize("sequence, count", SEQUENCES)
def test_every_dimension_is_stratified(sequence, count):
    for m in range(8):
        numbers = over_steps(sequence, count, 1 << m)
        assert (np.sort((numbers * (1 << m)).astype(int), axis=0) == np.arange(1 << m)[:, None, None]).all()


@pytest.mark.parametrize("step", [0, 1, 2, 64, 1000])
def test_uniform_over_pixels_at_any_step(step):
    drawn = np.concatenate([at_step(sequence, count, step) for sequence, count in SEQUENCES])
    assert sidak([uniformity(numbers) for numbers in drawn]) > SIGNIFICANCE


@pytest.mark.slow
@pytest.mark.parametrize("step", [1, 2, 64, 1000])
def test_one_pixel_is_uniform_over_seeds(step):
    pixel = torch.tensor([12345])
    numbers = np.stack([at_step(37, 6, step, seed, pixel)[:, 0] for seed in range(4096)], axis=1)
    for dimension in range(6):
        assert uniformity(numbers[dimension], bins=64) > SIGNIFICANCE
    assert independence(numbers[0], numbers[1], bins=8) > SIGNIFICANCE


@pytest.mark.parametrize("step", [1, 3, 64, 1000])
def test_the_dimensions_of_a_step_are_pairwise_independent(step):
    numbers = np.concatenate([at_step(sequence, count, step) for sequence, count in SEQUENCES])
    independent = PixelRandom(0, step, torch.arange(PIXELS)).uniform(2, 5).numpy()
    pairs = [(a, b) for i, a in enumerate(numbers) for b in (*numbers[i + 1 :], *independent)]
    assert sidak([independence(a, b) for a, b in pairs]) > SIGNIFICANCE


@pytest.mark.parametrize("apart", [1, 320, 1024, 1920])
def test_neighbouring_pixels_are_independent(apart):
    pixels = torch.arange(PIXELS)
    for dimension in (0, 1):
        a, b = at_step(0, 2, 21)[0], at_step(0, 2, 21, pixels=pixels + apart)[dimension]
        assert independence(a, b) > SIGNIFICANCE


def test_two_steps_of_neighbouring_pixels_are_independent():
    """Their scrambles are, not only their shifts, of which the exclusive or of two steps knows nothing."""
    early, late = at_step(0, 2, 3)[0], at_step(0, 2, 12)[0]
    moved = np.floor(late * 32).astype(int) ^ np.floor(early * 32).astype(int)
    both = moved[:-1:2] * 32 + moved[1::2]
    share = np.bincount(moved, minlength=32) / len(moved)
    assert (share > 0.0).sum() > 4
    assert chi_square(np.bincount(both, minlength=1024), np.outer(share, share).ravel()) > SIGNIFICANCE


@pytest.mark.slow
def test_sequences_of_different_names_are_paired_at_random():
    """Over 64 steps their correlation is about that of independent numbers, 1/8; without the shuffle it is 3/4."""
    correlations = []
    for seed in range(200):
        a, b = over_steps(0, 1, 64, pixels=1, seed=seed)[:, 0, 0], over_steps(33, 1, 64, pixels=1, seed=seed)[:, 0, 0]
        correlations.append(np.corrcoef(a, b)[0, 1])
    assert np.mean(np.square(correlations)) < 2.0 / 64


def test_the_shuffle_keeps_aligned_blocks_together():
    for key in (0, 1, 12345):
        shuffled = np.array([shuffle_index(index, key) for index in range(1 << 10)])
        for m in range(11):
            blocks = np.sort(shuffled.reshape(-1, 1 << m), axis=1)
            assert (blocks[:, 0] % (1 << m) == 0).all()
            assert (blocks == blocks[:, :1] + np.arange(1 << m)).all()
        assert (np.sort(shuffled) == np.arange(1 << 10)).all()
    assert {tuple(shuffle_index(index, key) for index in (2, 3)) for key in range(8)} == {(2, 3), (3, 2)}


def test_sobol_points_are_those_of_torch_in_another_order():
    engine = torch.quasirandom.SobolEngine(6)
    expected = engine.draw(256, dtype=torch.float64).numpy()
    points = np.array([[sobol_point(index, dimension) for dimension in range(6)] for index in range(256)]) / 2.0**31
    np.testing.assert_array_equal(np.unique(points, axis=0), np.unique(expected, axis=0))


def test_other_pixels_and_compaction_change_nothing():
    whole = PixelRandom(5, 9, torch.arange(1000))
    index = torch.tensor([999, 0, 3, 3, 500])
    expected = whole.stratified(37, 6)[:, index]
    assert torch.equal(whole.select(index).stratified(37, 6), expected)
    assert torch.equal(PixelRandom(5, 9, torch.arange(1000)[index]).stratified(37, 6), expected)
    assert torch.equal(whole.stratified(37, 2), whole.stratified(37, 6)[:2])


def test_numbers_differ_by_seed_step_and_name():
    numbers = [at_step(name, 1, step, seed) for name, step, seed in ((0, 5, 0), (0, 6, 0), (0, 5, 1), (33, 5, 0))]
    for i, a in enumerate(numbers):
        for b in numbers[i + 1 :]:
            assert (a != b).mean() > 0.999


INTEGRANDS = {
    "smooth": (lambda x, y: np.sin(3.0 * x) * y * y + x * y, 0.02),
    "bent": (lambda x, y: np.maximum(x + y - 1.0, 0.0), 0.05),
    "a disc": (lambda x, y: ((x - 0.4) ** 2 + (y - 0.5) ** 2 < 0.1).astype(float), 0.3),
}


@pytest.mark.parametrize("name", INTEGRANDS)
def test_averages_over_64_steps_are_unbiased_and_less_noisy(name):
    """Variance as a share of that of independent numbers."""
    integrand, share = INTEGRANDS[name]
    x, y = over_steps(0, 2, 64, pixels=4096).astype(float).transpose(1, 0, 2)
    means = integrand(x, y).mean(axis=0)
    fine = (np.arange(2000) + 0.5) / 2000
    values = integrand(fine[:, None], fine[None])
    assert z_test(means.mean() - values.mean(), np.sqrt(means.var(ddof=1) / 4096) + 1e-6) > SIGNIFICANCE
    assert means.var() < share * values.var() / 64


def test_a_sequence_may_begin_at_any_step():
    """One that begins later is as even from there on, and knows nothing of the others."""
    pixels = torch.arange(PIXELS)
    late = np.stack([PixelRandom(0, step, pixels[:16]).stratified(2, 2, first=9).numpy() for step in range(9, 41)])
    assert (np.sort((late * 32).astype(int), axis=0) == np.arange(32)[:, None, None]).all()
    numbers = PixelRandom(0, 20, pixels).stratified(2, 2, first=9).numpy()
    assert sidak([uniformity(row) for row in numbers]) > SIGNIFICANCE
    for step, first in ((20, 17), (20, 1), (8, 5), (8, 1)):
        others = PixelRandom(0, step, pixels).stratified(2, 2, first=first).numpy()
        assert sidak([independence(a, b) for a in numbers for b in others]) > SIGNIFICANCE


@pytest.mark.parametrize("first", [2, 3, 5, 9, 17, 33, 65, 129])
@pytest.mark.parametrize("dimension", [0, 32, 33, 37])
def test_the_lens_points_of_a_block_know_nothing_of_other_sequences(dimension, first):
    """Over pixels, at the same step: film position, choice of the lobe, first bounce, light."""
    pixels = torch.arange(PIXELS)
    random = PixelRandom(1, first + first // 2, pixels)
    lens, others = random.stratified(2, 3, first=first).numpy(), random.stratified(dimension, 1 if dimension == 32 else 2).numpy()
    assert sidak([independence(a, b) for a in lens for b in others]) > SIGNIFICANCE


def together(first: int, copies: int, numbers: int, pixels: int = 64) -> np.ndarray:
    """All samples of the epoch that begins at step `first`: `[3, steps * copies * numbers, pixels]`."""
    found = []
    for step in range(first, max(2 * first - 1, 2)):
        for copy in range(copies):
            random = PixelRandom(7, step, torch.arange(pixels)).copies(torch.full((pixels,), copy))
            found += [random.stratified(33, 3, first, number) for number in range(numbers)]
    return torch.stack(found, dim=1).numpy()


@pytest.mark.parametrize("first", [1, 2, 3, 5, 9])
@pytest.mark.parametrize("numbers", [1, 2, 4])
def test_all_samples_of_a_pair_of_copies_are_stratified_together(first, numbers):
    """Over an epoch: each dimension, and the elementary intervals of the first two. Copies of another pair are not among them."""
    points = together(first, 2, numbers)
    count = points.shape[1]
    assert (np.sort((points * count).astype(int), axis=1) == np.arange(count)[None, :, None]).all()
    m, (x, y) = count.bit_length() - 1, points[:2]
    for across in range(m + 1):
        cell = (x * (1 << across)).astype(int) * (1 << m - across) + (y * (1 << m - across)).astype(int)
        assert (np.sort(cell, axis=0) == np.arange(count)[:, None]).all()
    four = together(first, 4, numbers)[0]
    assert not (np.sort((four * 2 * count).astype(int), axis=0) == np.arange(2 * count)[:, None]).all()


GROUP = 16
"""Pixels of a group."""


def of_groups(step: int, first: int, groups: int = 64, seed: int = 7, size: int = GROUP) -> np.ndarray:
    """The numbers of three dimensions in a step: `[3, groups, members]`."""
    keys = torch.arange(groups, dtype=torch.int32).repeat_interleave(size)
    member = torch.arange(size, dtype=torch.int32).repeat(groups)
    random = PixelRandom(seed, step, torch.arange(groups * size)).in_groups(keys, member, size)
    return random.stratified(dimensions.LENS, 3, first).reshape(3, groups, size).numpy()


def in_all_intervals(points: np.ndarray) -> bool:
    """Whether each elementary interval of the first two dimensions has one of the N points `[3, N, ..]`."""
    (x, y), count = points[:2], points.shape[1]
    m = count.bit_length() - 1
    cells = [(x * (1 << a)).astype(int) * (1 << m - a) + (y * (1 << m - a)).astype(int) for a in range(m + 1)]
    return all((np.sort(cell, axis=0) == np.arange(count)[:, None]).all() for cell in cells)


@pytest.mark.parametrize("first", [1, 2, 3, 5, 9, 33])
@pytest.mark.parametrize("size", [2, GROUP, 64])
def test_all_samples_of_a_group_are_stratified_together_and_so_are_those_of_each_pixel(first, size):
    steps = max(first - 1, 1)
    points = np.stack(
        [of_groups(first + step, first, 8, size=size) for step in range(steps)], axis=1
    )  # [3, steps, groups, members]
    assert in_all_intervals(points.reshape(3, steps, -1))
    of_group = points.transpose(0, 1, 3, 2).reshape(3, steps * size, -1)
    assert in_all_intervals(of_group)
    assert (np.sort((of_group[2] * steps * size).astype(int), axis=0) == np.arange(steps * size)[:, None]).all()


def test_copies_and_further_samples_of_a_group_go_on_with_its_sequence():
    """All samples of the members, of a pair of copies and of two numbers are stratified together."""
    first, size, groups = 5, 4, 8
    pixels = torch.arange(groups * size)
    keys, member = (values.to(torch.int32) for values in (pixels // size, pixels % size))
    found = []
    for step in range(first, 2 * first - 1):
        random = PixelRandom(7, step, pixels).in_groups(keys, member, size)
        pair = [random.copies(torch.full_like(pixels, copy)) for copy in (0, 1)]
        found += [copies.stratified(dimensions.LENS, 3, first, number) for copies in pair for number in (0, 1)]
    points = torch.stack(found, 1).reshape(3, -1, groups, size).transpose(2, 3)
    assert in_all_intervals(points.reshape(3, -1, groups).numpy())


@pytest.mark.parametrize("step, first", [(1, 1), (7, 5), (20, 17), (100, 65)])
def test_members_of_a_group_are_uniform_and_groups_independent(step, first):
    numbers = of_groups(step, first, groups=1 << 13)
    assert sidak([uniformity(numbers[axis, :, member]) for axis in range(3) for member in (0, 1, GROUP - 1)]) > SIGNIFICANCE
    assert independence(numbers[0, :-1, 0], numbers[0, 1:, 0], bins=8) > SIGNIFICANCE
    assert independence(numbers[0, :, 3], numbers[1, :, 3], bins=8) > SIGNIFICANCE


@pytest.mark.parametrize("step, first", [(9, 9), (20, 17), (100, 65)])
def test_members_of_a_group_differ_in_each_step(step, first):
    """A group has numbers in more than half of the eighths of each dimension, on average over seeds."""
    counts = [[len(set((8.0 * row).astype(int))) for row in of_groups(step, first, 1, seed)[:, 0]] for seed in range(32)]
    assert (np.mean(counts, axis=0) > 4.5).all()


def test_outside_an_epoch_members_of_a_group_are_independent():
    numbers = of_groups(40, 9, groups=1 << 13)[0]
    assert independence(numbers[:, 0], numbers[:, 1], bins=8) > SIGNIFICANCE


@pytest.mark.parametrize("name", INTEGRANDS)
def test_means_over_a_group_are_unbiased_and_less_noisy(name):
    """Variance over that of pixels with sequences of their own, for the epoch of the steps 9 to 16."""
    integrand, _ = INTEGRANDS[name]
    x, y, _ = np.stack([of_groups(9 + step, 9, groups=1024) for step in range(8)], axis=1)
    means = integrand(x, y).mean(axis=(0, 2))
    of_pixels = over_steps(dimensions.LENS, 2, 8, 1024 * GROUP).transpose(1, 0, 2).reshape(2, 8, 1024, GROUP)
    alone = integrand(*of_pixels).mean(axis=(0, 2))
    fine = (np.arange(2000) + 0.5) / 2000
    expected = integrand(fine[:, None], fine[None]).mean()
    assert z_test(means.mean() - expected, np.sqrt(means.var(ddof=1) / 1024) + 1e-6) > SIGNIFICANCE
    assert means.var() < 0.6 * alone.var()


@pytest.mark.parametrize("step, first", [(9, 9), (20, 17), (40, 33), (100, 65)])
def test_bsdf_samples_of_a_pair_of_copies_avoid_the_coordinate_in_which_they_are_nearly_equal(step, first):
    """The other coordinates are in different quarters."""
    random = PixelRandom(3, step, torch.arange(1000))
    scatter = [random.copies(torch.full((1000,), copy)).stratified(33, 4, first) for copy in range(2)]
    assert ((scatter[0][0] * (first - 1)).int() == (scatter[1][0] * (first - 1)).int()).all()
    for one, other in zip(*map(dimensions.bsdf_numbers, scatter)):
        assert ((4.0 * one).int() != (4.0 * other).int()).all()


@pytest.mark.parametrize("step, first", [(7, 1), (13, 5), (6, 6)])
def test_copies_and_further_samples_are_independent_outside_an_epoch(step, first):
    random = PixelRandom(1, step, torch.arange(PIXELS))
    copies = [random.copies(torch.full((PIXELS,), copy)).stratified(33, 3, first) for copy in range(4)]
    drawn = [numbers[0].numpy() for numbers in (*copies, *(random.stratified(33, 3, first, number) for number in (1, 2)))]
    for at, numbers in enumerate(drawn):
        assert uniformity(numbers) > SIGNIFICANCE
        for other in drawn[:at]:
            assert independence(numbers, other) > SIGNIFICANCE


@pytest.mark.parametrize("copy, number", [(0, 1), (1, 0), (1, 3), (2, 1)])
def test_copies_and_further_samples_of_an_epoch_are_uniform(copy, number):
    random = PixelRandom(1, 6, torch.arange(PIXELS)).copies(torch.full((PIXELS,), copy))
    assert sidak([uniformity(numbers) for numbers in random.stratified(37, 6, 5, number).numpy()]) > SIGNIFICANCE
