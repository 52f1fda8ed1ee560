"""Pairwise MIS: the weights of all that a point can have come from sum to 1."""

import numpy as np
import torch

from bokehguide.baselines.restir.pairwise_mis import centre_share, neighbour_weight

NEIGHBOURS, POINTS = 7, 1000


def sum_of_weights(jacobian_back=torch.reciprocal, weight=neighbour_weight, share=centre_share) -> torch.Tensor:
    """Σ m at random points of the centre, each with its p̂ in every neighbour and the Jacobians of the ways there.

    In a third of the neighbours the point cannot be.
    """
    random = np.random.default_rng(1)
    shapes = (POINTS, (NEIGHBOURS, POINTS), (NEIGHBOURS, POINTS))
    centre, theirs, jacobian = (torch.from_numpy(random.lognormal(0.0, 2.0, shape)) for shape in shapes)
    theirs = theirs * torch.from_numpy(random.random((NEIGHBOURS, POINTS)) > 1 / 3)
    count = torch.full((POINTS,), float(NEIGHBOURS), dtype=torch.float64)
    total = 1.0 / (count + 1.0)
    for target, forth in zip(theirs, jacobian):
        total = total + weight(target, centre, forth, count) + share(centre, target, jacobian_back(forth), count)
    return total


def test_weights_sum_to_one():
    torch.testing.assert_close(sum_of_weights(), torch.ones(POINTS, dtype=torch.float64), rtol=1e-12, atol=0.0)


def test_defects_show():
    """A Jacobian left out on either side or on both, or turned round; confidences that changed places."""

    def swapped(target, shifted, jacobian, count):
        return count * neighbour_weight(target, shifted, jacobian, 1.0 / count) / (count + 1.0)

    defects = [
        {"jacobian_back": torch.ones_like},
        {"jacobian_back": lambda jacobian: jacobian},
        {"weight": lambda target, shifted, jacobian, count: neighbour_weight(target, shifted, 1.0, count)},
        {"weight": swapped},
        {"share": lambda target, shifted, jacobian, count: centre_share(target, shifted, jacobian, 1.0 / count)},
        {"share": lambda target, shifted, jacobian, count: centre_share(target, shifted, jacobian, 1.0)},
    ]
    for defect in defects:
        assert float((sum_of_weights(**defect) - 1.0).abs().mean()) > 0.02, defect


def test_what_is_black_everywhere_has_finite_weights():
    black, ones = torch.zeros(3), torch.ones(3)
    for function in (neighbour_weight, centre_share):
        assert bool(function(black, black, ones, 4.0 * ones).isfinite().all())


def test_alone_a_pixel_counts_whole():
    """Where none of the neighbours could have found the sample, m_c = 1."""
    count = torch.tensor([5.0])
    share = 1.0 / (count + 1.0) + 5 * centre_share(torch.tensor([2.0]), torch.zeros(1), torch.ones(1), count)
    torch.testing.assert_close(share, torch.ones(1))
