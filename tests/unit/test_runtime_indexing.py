"""Indices at which a mask is true."""

import pytest
import torch

from bokehguide.runtime.indexing import indices


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
@pytest.mark.parametrize("size", [0, 1, 10_000])
def test_indices_are_in_order(size, share):
    mask = torch.rand(2 * size, generator=torch.Generator().manual_seed(size)) < share
    for view in (mask, mask[::2]):
        found = indices(view)
        assert found.dtype == torch.int64
        assert torch.equal(found, view.nonzero()[:, 0])
