"""Spans of pixels that take threads equally long."""

from __future__ import annotations

import numpy as np
import pytest

from bokehguide.train.batches import BATCH, LARGEST, SMALL_BATCH, Batches


def lengths(spans: list[slice]) -> np.ndarray:
    return np.array([span.stop - span.start for span in spans])


@pytest.mark.parametrize("threads", [1, 2, 16])
@pytest.mark.parametrize("pixels", [0, 1, SMALL_BATCH, 2 * SMALL_BATCH + 1, BATCH, 1280 * 720, 10 * BATCH])
def test_every_pixel_is_in_one_span(pixels, threads):
    batches = Batches(threads)
    for seconds in (1.0, 3.0, 0.5):
        spans = batches.spans(pixels)
        assert [number for span in spans for number in (span.start, span.stop)][1:-1:2] == [span.start for span in spans][1:]
        assert lengths(spans).sum() == pixels and all(lengths(spans) > 0)
        assert all(lengths(spans) <= LARGEST * BATCH)
        batches.took([seconds + number for number in range(len(spans))])


def test_they_are_cut_so_that_they_take_equally_long():
    """The lower half of the picture takes three times as long as the upper one."""
    batches, pixels = Batches(2), 200_000
    cost = np.where(np.arange(pixels) < pixels // 2, 1.0, 3.0)
    assert lengths(batches.spans(pixels)).tolist() == [pixels // 2] * 2
    for _ in range(12):
        took = [cost[span].sum() for span in batches.spans(pixels)]
        batches.took(took)
    assert took[0] == pytest.approx(took[1], rel=0.01)
    assert lengths(batches.spans(pixels))[0] == pytest.approx(pixels * 2 / 3, rel=0.01)


def test_none_grows_beyond_what_memory_allows():
    """However cheap its pixels are."""
    batches = Batches(2)
    for _ in range(50):
        spans = batches.spans(2 * BATCH)
        batches.took([1e-6, 1.0])
    assert lengths(spans).max() <= LARGEST * BATCH


def test_another_number_of_pixels_begins_with_even_spans():
    batches = Batches(2)
    batches.spans(200_000)
    batches.took([1.0, 2.0])
    assert len(set(lengths(batches.spans(200_000)).tolist())) == 2
    assert lengths(batches.spans(4 * BATCH)).tolist() == [BATCH] * 4
