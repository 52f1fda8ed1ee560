"""Which pixels a pixel borrows from: evenly in the disc, none off the frame."""

import numpy as np
import torch
from scipy import stats

from bokehguide.baselines.restir.neighbours import TABLE_SIZE, Neighbourhood, disc_offsets
from tests.support.statistical import chi_square


def test_offsets_fill_the_disc_evenly():
    """By area and by direction, all of them and each 32 in a row; evenly is better than at random."""
    x, y = disc_offsets(TABLE_SIZE).double().numpy()
    area, turn = x * x + y * y, np.arctan2(y, x) / (2.0 * np.pi) + 0.5
    assert len(x) == TABLE_SIZE and area.max() < 1.0
    counts, _, _ = np.histogram2d(area, turn, bins=16, range=((0, 1), (0, 1)))
    assert chi_square(counts, np.full(counts.shape, 1 / 256)) > 0.9
    runs = [slice(start, start + 32) for start in range(0, TABLE_SIZE - 32, 97)]
    # At random it would be 0.15 and 0.11.
    assert np.mean([stats.kstest(area[run], "uniform").statistic for run in runs]) < 0.12
    assert np.mean([np.hypot(x[run].mean(), y[run].mean()) for run in runs]) < 0.06


def test_neighbours_are_within_the_radius_and_on_the_frame():
    width, height, radius, count = 60, 40, 7.0, 32
    neighbourhood = Neighbourhood(width, height, radius, count)
    pixels = torch.arange(width * height)
    start = torch.rand(len(pixels), generator=torch.Generator().manual_seed(0))
    found = neighbourhood.of(pixels, start)
    assert found.shape == (count, len(pixels))
    there = found >= 0
    dx, dy = found % width - pixels % width, found // width - pixels // width
    far = torch.hypot(dx.float(), dy.float())[there]
    assert float(far.max()) <= radius + 0.75 and float(far.min()) >= 1.0
    assert int(found.max()) < width * height
    x, y = pixels % width, pixels // width
    inner = (x >= 8) & (x < width - 8) & (y >= 8) & (y < height - 8)
    corner = (x == 0) & (y == 0)
    # Inside only the pixel itself is left out, once in 154 pixels of the disc; in a corner three quarters are.
    assert float(there[:, inner].float().mean()) > 0.98
    assert abs(float(there[:, corner].float().mean()) - 0.3) < 0.12


def test_each_pixel_of_the_disc_is_as_likely():
    neighbourhood = Neighbourhood(101, 101, 10.0, 4)
    centre = torch.full((50_000,), 50 * 101 + 50)
    start = torch.rand(len(centre), generator=torch.Generator().manual_seed(1))
    found = neighbourhood.of(centre, start).ravel()
    counts = torch.bincount(found[found >= 0], minlength=101 * 101).reshape(101, 101)
    y, x = torch.meshgrid(torch.arange(101) - 50, torch.arange(101) - 50, indexing="ij")
    whole = (torch.hypot(x.abs() + 0.5, y.abs() + 0.5) < 10.0) & ((x != 0) | (y != 0))
    inside = counts[whole].double()
    assert float(inside.std() / inside.mean()) < 0.1
