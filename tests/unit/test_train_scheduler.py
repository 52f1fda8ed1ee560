"""Spans of pixels of equal cost."""

from __future__ import annotations

import numpy as np
import pytest

from bokehguide.train.scheduler import (
    BATCH,
    GPU_BATCH,
    GPU_SHARE,
    GPU_THREADS,
    LONGEST,
    NEWEST,
    OVERHEAD,
    PATH_BYTES,
    SHORTEST,
    SMALL_GPU_BATCH,
    Batches,
)

SMALL = 28_800
"""Pixels of a batch that has little overhead."""


def lengths(spans: list[slice]) -> np.ndarray:
    return np.array([span.stop - span.start for span in spans])


@pytest.mark.parametrize("paths", [1, 4])
@pytest.mark.parametrize("threads", [1, 2, 16])
@pytest.mark.parametrize("pixels", [0, 1, SMALL, 3 * SMALL + 1, BATCH, 1280 * 720, 10 * BATCH])
def test_every_pixel_is_in_one_span_of_a_fair_size(pixels, threads, paths):
    """Whatever the spans take: from one step to the next that may change as it likes."""
    batches, rng = Batches(threads, paths), np.random.default_rng(1)
    for _ in range(20):
        spans = batches.spans(pixels)
        ends = [0] + [span.stop for span in spans]
        assert [span.start for span in spans] == ends[:-1] and ends[-1] == pixels
        assert all(lengths(spans) >= SHORTEST * pixels // max(len(spans), 1)) and all(lengths(spans) <= LONGEST * BATCH / paths)
        batches.took(rng.exponential(size=len(spans)) ** 4 + 1e-3)


@pytest.mark.parametrize("threads", [2, 5])
def test_they_are_cut_so_that_they_take_equally_long(threads):
    """The lower half of the picture takes 1.8 times as long as the upper one. Bounds are means over several steps."""
    batches, pixels = Batches(threads), 200_000
    cost = np.where(np.arange(pixels) < pixels // 2, 1.0, 1.8)
    assert np.ptp(lengths(batches.spans(pixels))) <= 1
    for _ in range(10):
        costs = [cost[span].sum() for span in batches.spans(pixels)]
        batches.took(costs)
    assert max(costs) < 1.01 * min(costs)


def test_one_slow_batch_moves_the_bounds_by_a_part_only():
    """Another process may delay a batch of one step. The bounds of the next step move by NEWEST of the way, and then back."""
    batches, pixels = Batches(2), 200_000
    batches.spans(pixels)
    batches.took([1.0, 1.5])
    moved = batches.spans(pixels)[0].stop / pixels - 0.5
    best = 0.5 + 0.25 / 3.0  # half of 2.5 seconds, at the second batch's rate of 3 seconds for the whole picture
    assert moved == pytest.approx(NEWEST * (best - 0.5), abs=1e-5)
    for _ in range(12):
        batches.took([span.stop - span.start for span in batches.spans(pixels)])
    assert batches.spans(pixels)[0].stop == pytest.approx(pixels / 2, abs=0.001 * pixels)


def test_bounds_reach_the_nearest_end_though_they_move_by_parts():
    """The first part of the way is less than half of the distance to the next allowed place."""
    batches, pixels, ends = Batches(2), 200_000, np.arange(0, 200_001, 20_000)
    cost = np.where(np.arange(pixels) < pixels // 2, 1.0, 1.5)  # equal at 116,667
    for _ in range(10):
        batches.took([cost[span].sum() for span in batches.spans(pixels, ends)])
    assert batches.spans(pixels, ends)[0].stop == 120_000


def test_where_they_cannot_cost_the_same_they_come_as_near_as_their_sizes_may():
    batches = Batches(2)
    for _ in range(30):
        batches.spans(100_000)
        batches.took([1.0, 1000.0])
    assert lengths(batches.spans(100_000)).tolist() == [75_000, 25_000]  # 0.5 is SHORTEST
    for _ in range(30):
        batches.spans(2 * BATCH)
        batches.took([1000.0, 1.0])
    assert lengths(batches.spans(2 * BATCH)).tolist() == [BATCH // 2, 3 * BATCH // 2]


@pytest.mark.parametrize("paths", [1, 2])
@pytest.mark.parametrize("gpu", [False, True])
def test_they_have_the_largest_number_of_pixels_over_the_number_of_paths(paths, gpu):
    batches, largest = (Batches.on_gpu(float("inf"), paths), GPU_BATCH) if gpu else (Batches(2, paths), BATCH)
    for _ in range(2):
        assert lengths(batches.spans(4 * largest)).tolist() == [largest // paths] * 4 * paths
        batches.took([1.0] * 4 * paths)


@pytest.mark.parametrize("paths", [1, 2])
@pytest.mark.parametrize("gigabytes", [0.1, 2.0, 6.0])
def test_the_batches_of_a_gpu_fit_its_free_memory(gigabytes, paths):
    """All threads together take a share of the memory, whatever the size of the picture."""
    free = gigabytes * 1e9
    for pixels in (320 * 180, 640 * 360, 1920 * 1080, 3840 * 2160):
        longest = max(lengths(Batches.on_gpu(free, paths).spans(pixels)))
        assert longest * paths * PATH_BYTES * GPU_THREADS <= GPU_SHARE * free


@pytest.mark.parametrize("pixels", [1, OVERHEAD, 192 * 108, 320 * 180, 640 * 360, 1280 * 720])
def test_the_overhead_of_all_batches_takes_no_longer_than_one_batch(pixels):
    """On any number of threads; another batch would break the rule."""
    count = len(Batches(1000).spans(pixels))
    assert count == 1 or count * OVERHEAD <= pixels / count
    assert (count + 1) * OVERHEAD > pixels / (count + 1)


def test_a_gpu_renders_a_small_picture_in_one_batch():
    assert len(Batches.on_gpu(float("inf")).spans(2 * SMALL_GPU_BATCH - 1)) == 1


def test_another_number_of_spans_begins_with_even_ones():
    batches = Batches(2)
    batches.spans(200_000)
    batches.took([1.0, 2.0])
    assert np.ptp(lengths(batches.spans(100_000))) > 1000
    assert lengths(batches.spans(4 * BATCH)).tolist() == [BATCH] * 4


def bands(pixels: int, seed: int = 0) -> np.ndarray:
    """Ends of bands of several sizes, some of them large."""
    rng = np.random.default_rng(seed)
    cuts = rng.choice(np.arange(1, pixels), size=min(25, pixels - 1), replace=False) if pixels > 1 else np.zeros(0, int)
    return np.unique(np.concatenate(([0, pixels], cuts)))


@pytest.mark.parametrize("threads", [1, 3, 16])
@pytest.mark.parametrize("pixels", [0, 1, 100, SMALL, 7 * SMALL + 1, 4 * BATCH])
def test_they_are_cut_where_they_may_be_and_every_pixel_is_in_one_span(pixels, threads):
    """Whatever they cost, and whatever the ends are from step to step."""
    batches, rng = Batches(threads), np.random.default_rng(1)
    for step in range(20):
        ends = bands(pixels, step // 10)
        spans = batches.spans(pixels, ends)
        places = [0] + [span.stop for span in spans]
        assert [span.start for span in spans] == places[:-1] and places[-1] == pixels
        assert set(places) <= set(ends.tolist()) and all(lengths(spans) > 0)
        batches.took(rng.exponential(size=len(spans)) ** 4 + 1e-3)


def test_each_cut_is_at_the_nearest_end():
    spans = Batches(4).spans(4 * SMALL, np.array([0, 20_000, 30_000, 55_000, 70_000, 80_000, 4 * SMALL]))
    assert [span.stop for span in spans] == [30_000, 55_000, 80_000, 4 * SMALL]


def test_where_there_are_fewer_ends_than_spans_there_are_fewer_spans():
    pixels = 8 * SMALL
    batches = Batches(8)
    assert len(batches.spans(pixels)) == 8
    for _ in range(5):
        spans = batches.spans(pixels, np.array([0, pixels // 3, pixels]))
        assert lengths(spans).tolist() == [pixels // 3, pixels - pixels // 3]
        batches.took([1.0, 3.0])
    assert len(batches.spans(pixels, np.array([0, pixels]))) == 1


@pytest.mark.parametrize("threads", [2, 5])
def test_cut_where_they_may_be_they_cost_the_same_but_for_a_band(threads):
    """The lower half of the picture costs 1.8 times as much as the upper one; spans end within half a band of even shares."""
    batches, pixels, band = Batches(threads), 200_000, 2_000
    cost = np.where(np.arange(pixels) < pixels // 2, 1.0, 1.8)
    ends = np.arange(0, pixels + 1, band)
    for _ in range(10):
        costs = [cost[span].sum() for span in batches.spans(pixels, ends)]
        batches.took(costs)
    assert len(costs) == threads and max(costs) - min(costs) < 2.0 * 1.8 * band


EVEN_ENDS = [np.linspace(0, 12_000, count + 1).astype(int) for count in (5, 6, 7, 12)]


@pytest.mark.parametrize("ends", [*EVEN_ENDS, np.array([0, 1000, 2000, 3000, 4000, 5000, 12_000])], ids=len)
def test_every_thread_has_a_batch_where_there_are_enough_ends(ends):
    """Also where the best bounds of several batches are nearest to the same end, at the start, in the middle and at the end."""
    batches = Batches(5, smallest=1)
    for dear in range(5):
        for _ in range(8):
            spans = batches.spans(12_000, ends)
            assert len(spans) == 5 and all(lengths(spans) > 0)
            batches.took([100.0 if place == dear else 1.0 for place in range(5)])
