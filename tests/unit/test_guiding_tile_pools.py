"""Estimates of numbers of tiles from few samples, with the help of the tiles around them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bokehguide.guiding.tile_pools import DOUBT, ESTIMATES, PRIOR_ARRIVALS, SCALE_SQUARE, SQUARES, TilePools
from bokehguide.runtime import native

ACROSS, DOWN = 40, 18
POOLS = TilePools(ACROSS, DOWN)


@pytest.fixture(autouse=True)
def pytorch(monkeypatch):
    """The code of PyTorch, with which `test_native_sums.py` compares the core."""
    monkeypatch.setenv(native.SWITCH, "0")


def around(values: np.ndarray, row: int, column: int, width: int) -> np.ndarray:
    """The tiles of a square, `[tiles, C]`; values: `[down, across, C]`."""
    half = width // 2
    square = values[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
    return square.reshape(-1, values.shape[2])


def sampled(probability: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Sums of the moments and of the numbers of `count` samples a tile; probability: of clusters, `[tiles, C]`."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.multinomial(probability, count, replacement=True, generator=generator)
    moments = torch.exp(torch.randn(drawn.shape, generator=generator, dtype=torch.float64))
    sums = torch.zeros(2, *probability.shape, dtype=torch.float64)
    for total, values in zip(sums, (moments, torch.ones_like(moments))):
        total.scatter_add_(1, drawn, values)
    return sums[0], sums[1]


def shares(moments: Tensor) -> Tensor:
    return moments / moments.sum(1, keepdim=True)


def test_estimates_agree_with_plain_loops():
    """Of tiles in the middle, at edges and in corners, with tiles and a cluster without samples."""
    generator = torch.Generator().manual_seed(1)
    moments, arrived = torch.exp(3.0 * torch.randn(2, DOWN, ACROSS, 5, generator=generator, dtype=torch.float64))
    moments[:, :, 4] = arrived[:, :, 4] = 0.0
    moments[:3, 30:] = arrived[:3, 30:] = 0.0
    found = POOLS.shrunk(moments.view(-1, 5), arrived.view(-1, 5)).view(DOWN, ACROSS, 5)
    relative = np.zeros(moments.shape)
    for row, column in np.ndindex(DOWN, ACROSS):
        scale = around(moments.numpy(), row, column, SCALE_SQUARE).mean(0).sum()
        relative[row, column] = moments[row, column] / scale if scale > 0.0 else 0.0
    for row, column in ((0, 0), (17, 39), (1, 38), (8, 20), (9, 3), (17, 16)):
        estimates = [around(relative, row, column, SQUARES[0]).mean(0)]
        expected = around(arrived.numpy(), row, column, SQUARES[0]).mean(0)
        for width in SQUARES[1:]:
            values, numbers = around(relative, row, column, width), around(arrived.numpy(), row, column, width)
            weight = expected * len(values)
            prior = PRIOR_ARRIVALS / np.where(numbers.sum(0) > 0.0, 1.0, 1.0 + (weight / DOUBT) ** 2)
            estimates.append((prior * estimates[-1] + weight * values.mean(0)) / (prior + weight))
            expected = (prior * expected + weight * numbers.mean(0)) / (prior + weight)
        estimate = ESTIMATES[0] * estimates[-1] + ESTIMATES[1] * estimates[-2]
        np.testing.assert_allclose(found[row, column], estimate, rtol=1e-12)


def test_estimates_tend_to_the_moments_of_the_tile_and_its_neighbours():
    probability = torch.rand(ACROSS * DOWN, 6, generator=torch.Generator().manual_seed(2))
    errors = []
    for count in (30, 300, 3000):
        moments, arrived = sampled(probability, count, count)
        table = moments.view(DOWN, ACROSS, 6).numpy()
        near = np.stack([around(table, *place, SQUARES[-2]).mean(0) for place in np.ndindex(DOWN, ACROSS)])
        limit = ESTIMATES[0] * shares(moments) + ESTIMATES[1] * shares(torch.from_numpy(near))
        errors.append(float((shares(POOLS.shrunk(moments, arrived)) - limit).abs().max()))
    assert errors[0] > 3.0 * errors[1] > 9.0 * errors[2] > 0.0


def test_few_samples_are_better_estimates_with_the_tiles_around_them():
    """The noise of light samples of 40 clusters, from 12 samples a tile, against probabilities of the tile alone."""
    column = torch.arange(ACROSS, dtype=torch.float32).repeat(DOWN)
    middle = torch.linspace(0.0, ACROSS, 40)
    probability = torch.exp(-(((column[:, None] - middle) / 12.0) ** 2))
    moments, arrived = sampled(probability, 12, 3)
    roots = probability.double().sqrt()

    def noise(estimate: Tensor) -> float:
        """Mean second moment over the least one; a share of the draws is even."""
        drawn = 0.875 * shares(estimate.sqrt()) + 0.125 / 40
        return float(((roots**2 / drawn).sum(1) / roots.sum(1) ** 2).mean())

    alone, pooled, shrunk = noise(moments), noise(POOLS.pooled(moments)), noise(POOLS.shrunk(moments, arrived))
    assert 1.0 < shrunk < 1.2 and shrunk < pooled - 0.03 and pooled < alone


def test_a_blocked_cluster_falls_to_zero_as_other_tiles_see_it():
    """Three by three tiles in the middle never see the first cluster."""
    probability = torch.ones(DOWN, ACROSS, 4)
    probability[8:11, 19:22, 0] = 0.0
    middle = 9 * ACROSS + 20
    found = [float(shares(POOLS.shrunk(*sampled(probability.view(-1, 4), count, 4)))[middle, 0]) for count in (1, 8, 64)]
    assert 0.05 < found[0] < 0.25 and found[1] < 0.02 and found[2] < 2e-3


def test_a_bright_tile_does_not_outweigh_the_others():
    """Of all clusters but one, so that its share would change in the whole frame."""
    moments, arrived = sampled(torch.ones(ACROSS * DOWN, 4), 20, 5)
    bright = moments.clone()
    bright[0, :3] *= 1e9
    far = torch.arange(ACROSS * DOWN) % ACROSS > 4
    before, after = (shares(POOLS.shrunk(each, arrived))[far] for each in (moments, bright))
    assert not torch.equal(before, after)
    assert float((before - after).abs().max()) < 0.02
