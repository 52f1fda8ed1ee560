"""Alias tables: what the columns add up to, and what is drawn from them."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from bokehguide.render.lights.alias_table import AliasTable, _columns
from bokehguide.render.random import PixelRandom
from tests.support.statistical import SIGNIFICANCE, chi_square

GENERATOR = np.random.default_rng(5)
WEIGHTS = {
    "one": np.array([3.0]),
    "one of two": np.array([0.0, 1.0]),
    "zeros": np.array([0.0, 2.0, 0.0, 5.0, 0.0]),
    "exact multiples of the mean": np.array([1.0, 1.0, 3.0, 3.0, 2.0, 0.0, 4.0]),
    "half of them zero": np.repeat([0.0, 1.0], 1000),
    "halves interleaved": np.tile([0.0, 1.0], 1000),
    "extremes": np.array([1e-30, 1.0, 1e30]),
    "heavy tail": GENERATOR.pareto(0.3, 1000),
    "log-normal": np.exp(GENERATOR.normal(0.0, 10.0, 5000)),
    "a million": GENERATOR.uniform(size=10**6),
    "one among a million": np.append(GENERATOR.uniform(size=10**6 - 1), 1e12),
    "falling": np.arange(1000.0, 0.0, -1.0),
}


@pytest.mark.parametrize("name", WEIGHTS)
def test_columns_reproduce_the_weights(name):
    weights = WEIGHTS[name]
    keep, alias = _columns(weights * (len(weights) / weights.sum()))
    assert keep.min() >= 0.0 and keep.max() <= 1.0
    found = keep + np.bincount(alias, 1.0 - keep, len(weights))
    expected = weights * (len(weights) / weights.sum())
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)
    assert not found[weights == 0.0].any()


@pytest.mark.parametrize("value", [0.1, 0.3, 1.7, 1e-20])
def test_equal_weights_of_any_number(value):
    for count in range(1, 200):
        table = AliasTable(np.full(count, value))
        every = torch.stack(((torch.arange(count) + 0.5) / count, torch.full((count,), 0.75)))
        assert torch.equal(table.sample(every), torch.arange(count)), count


@pytest.mark.parametrize("name", ["zeros", "exact multiples of the mean", "heavy tail", "falling"])
def test_draws_follow_the_weights(name):
    weights = WEIGHTS[name]
    drawn = AliasTable(weights).sample(PixelRandom(2, 0, torch.arange(500_000)).uniform(0, 2))
    assert chi_square(np.bincount(drawn.numpy(), minlength=len(weights)), weights / weights.sum()) > SIGNIFICANCE


def test_pdf_is_the_share_of_the_weight():
    table = AliasTable(np.array([1.0, 0.0, 3.0]))
    assert table.pdf(torch.tensor([2, 1, 0, 2])).tolist() == [0.75, 0.0, 0.25, 0.75]


def test_the_largest_uniform_number_stays_in_range():
    for count in (1, 3, 1000, 10**6):
        drawn = AliasTable(np.ones(count)).sample(torch.tensor([[1.0 - 2.0**-24], [0.5]]))
        assert drawn.item() == count - 1


def rows() -> tuple[np.ndarray, np.ndarray]:
    """Weights of five rows, and where each starts; sums from 1e-20 to 1e20."""
    parts = [np.array([1.0, 2.0]), WEIGHTS["zeros"], 1e-20 * WEIGHTS["falling"], np.ones(3), 1e20 * WEIGHTS["heavy tail"]]
    return np.concatenate(parts), np.cumsum([0] + [len(part) for part in parts])


def test_each_row_draws_by_its_own_weights_and_from_no_other():
    weights, starts = rows()
    row = torch.arange(500_000) % 5
    table = AliasTable(weights, starts=starts)
    drawn = table.sample(PixelRandom(3, 0, torch.arange(500_000)).uniform(0, 2), row).numpy()
    for i, (low, high) in enumerate(pairwise(starts)):
        counts = np.bincount(drawn[row == i], minlength=len(weights))
        assert counts[low:high].sum() == 100_000
        assert chi_square(counts[low:high], weights[low:high] / weights[low:high].sum()) > SIGNIFICANCE


def test_the_pdf_of_a_row_sums_to_one():
    weights, starts = rows()
    pdf = AliasTable(weights, starts=starts).pdf(torch.arange(len(weights))).double().numpy()
    for low, high in pairwise(starts):
        np.testing.assert_allclose(pdf[low:high], weights[low:high] / weights[low:high].sum(), rtol=1e-6)


def test_the_largest_and_least_uniform_numbers_stay_in_their_row():
    starts = np.cumsum([0, 1, 3, 1000, 10**6])
    table, row = AliasTable(np.ones(starts[-1]), starts=starts), torch.arange(4)
    for u, expected in ((1.0 - 2.0**-24, starts[1:] - 1), (2.0**-24, starts[:-1])):
        drawn = table.sample(torch.tensor([[u], [0.5]]).expand(2, 4), row)
        assert drawn.tolist() == expected.tolist()
