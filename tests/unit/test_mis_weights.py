"""MIS weights: they sum to 1, and a learned factor never gives a BSDF sample a large contribution."""

import pytest
import torch

from bokehguide.render.bsdf.dielectric import DELTA_PDF
from bokehguide.render.mis import BROAD, BsdfWeights, broad_share, power_heuristic

RATIOS = torch.logspace(-12, 12, 200)
"""Densities of light samples over those of BSDF samples."""


@pytest.mark.parametrize("factor", [0.0, 0.05, 0.6, 1.0])
@pytest.mark.parametrize("pdf", [1e-3, 1.0, 1e4])
def test_the_weights_of_both_techniques_sum_to_one(pdf, factor):
    of_bsdf, of_light = torch.full_like(RATIOS, pdf), pdf * RATIOS
    weights = BsdfWeights.with_factor(of_bsdf, of_light, factor)
    light = power_heuristic(of_light, of_bsdf) * (1.0 - (1.0 - factor) * broad_share(of_light, of_bsdf))
    torch.testing.assert_close(weights.weight + light, torch.ones_like(RATIOS))
    assert bool((weights.weight >= 0.0).all() and (light >= 0.0).all())
    moved = weights.weight - power_heuristic(of_bsdf, of_light)
    torch.testing.assert_close(moved, (1.0 - factor) * weights.broad, atol=1e-6, rtol=1e-5)


def test_a_factor_of_one_is_the_power_heuristic():
    of_bsdf = torch.ones_like(RATIOS)
    assert torch.equal(BsdfWeights.with_factor(of_bsdf, RATIOS, 1.0).weight, power_heuristic(of_bsdf, RATIOS))


def test_the_contribution_of_a_bsdf_sample_stays_near_that_of_light_samples():
    """A light of one radiance contributes 1 / r with light samples that are r times as dense."""
    weights = BsdfWeights.with_factor(torch.ones_like(RATIOS), RATIOS, 0.0).weight
    assert 0.4 * BROAD < float((weights * RATIOS).max()) < 0.6 * BROAD


def test_mirrors_and_lights_without_samples_leave_all_weight_to_the_bsdf():
    for pdf, light in ((DELTA_PDF, 1e6), (0.3, 0.0)):
        weights = BsdfWeights.with_factor(torch.tensor([pdf]), torch.tensor([light]), torch.tensor([0.2]))
        assert float(weights.weight) == pytest.approx(1.0, abs=1e-6) and float(weights.broad) == pytest.approx(0.0, abs=1e-6)
