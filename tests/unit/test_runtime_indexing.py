"""Indices at which a mask is true, and rows, columns and tiles of pixels."""

import pytest
import torch

from bokehguide.runtime.indexing import indices, rows_and_columns, tile_numbers


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
@pytest.mark.parametrize("size", [0, 1, 10_000])
def test_indices_are_in_order(size, share):
    mask = torch.rand(2 * size, generator=torch.Generator().manual_seed(size)) < share
    for view in (mask, mask[::2]):
        found = indices(view)
        assert found.dtype == torch.int64
        assert torch.equal(found, view.nonzero()[:, 0])


@pytest.mark.parametrize("width", [1, 3, 4, 49, 640, 3840, 65_535, 65_536])
def test_rows_and_columns_are_quotients_and_remainders(width):
    """Also at the ends of rows, where a rounded quotient would reach the next row."""
    starts = torch.randint(0, 2**28 // width, (2000,), generator=torch.Generator().manual_seed(width)) * width
    numbers = torch.cat((starts, starts + width - 1, starts + width // 2))
    rows, columns = rows_and_columns(numbers, width)
    assert rows.dtype == columns.dtype == torch.int64
    assert torch.equal(rows, numbers // width) and torch.equal(columns, numbers % width)


@pytest.mark.parametrize(("width", "side"), [(14, 4), (16, 4), (3, 4), (17, 3)])
def test_tiles_are_numbered_row_by_row(width, side):
    numbers = torch.arange(width * 11)
    across = -(-width // side)
    expected = [row // side * across + column // side for row in range(11) for column in range(width)]
    assert tile_numbers(numbers, width, side).tolist() == expected
