"""Places of a batch: those at which a mask is true."""

import pytest
import torch

from bokehguide.render.pixels import indices


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
@pytest.mark.parametrize("size", [0, 1, 10_000])
def test_true_places_are_found_in_order(size, share):
    mask = torch.rand(2 * size, generator=torch.Generator().manual_seed(size)) < share
    for view in (mask, mask[::2]):
        found = indices(view)
        assert found.dtype == torch.int64
        assert torch.equal(found, view.nonzero()[:, 0])
