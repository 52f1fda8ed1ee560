"""Means of renders in all modes, while the guide learns and after."""

import numpy as np
import pytest

from bokehguide.train import LENS_MODES
from tests.support.render_checks import (
    FINER_SPP,
    REFERENCE_SPP,
    frozen,
    furnace,
    learning,
    means_check,
    one_everywhere,
    uniform_reference,
)
from tests.support.statistical import SIGNIFICANCE

GUIDED = LENS_MODES[1:]


def reference_spp(mode: str) -> int:
    return FINER_SPP if mode == "guided" else REFERENCE_SPP


@pytest.mark.slow
@pytest.mark.parametrize("mode", LENS_MODES)
def test_furnace_comes_out_one(mode):
    """Every pixel within its noise, and the frame within half a percent."""
    found = furnace(mode, controlled=False)
    assert one_everywhere(found) > SIGNIFICANCE
    assert found.mean.mean() == pytest.approx(1.0, abs=0.005)
    if mode == "uniform":
        np.testing.assert_allclose(found.mean, 1.0, atol=1e-5)
    else:
        # Guided draws fall outside the lens even where β is small; `guided` clips its ellipses near the lens.
        assert found.last.outside > (0.003 if mode == "guided" else 0.01)
        assert (found.variance > 1e-5).mean() > 0.5


@pytest.mark.slow
def test_the_control_variate_removes_nearly_all_noise_of_a_furnace():
    """All noise comes from the weights; the mean of every pixel is 1 within the remaining noise."""
    found, noisy = furnace("guided"), furnace("guided", controlled=False)
    assert one_everywhere(found) > SIGNIFICANCE
    assert found.mean.mean() == pytest.approx(1.0, abs=5e-4)
    assert found.variance.mean() < 0.02 * noisy.variance.mean()


@pytest.mark.parametrize("run", [learning, pytest.param(frozen, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mode", GUIDED)
def test_means_while_and_after_learning_are_those_of_the_uniform_lens(mode, run):
    found = run(mode)
    assert found.last.gaussians > 0 and found.last.outside > 0.05
    assert means_check(found, reference_spp(mode)) > SIGNIFICANCE


@pytest.mark.slow
def test_the_reference_sees_the_emitters():
    mean = uniform_reference().mean
    assert mean.max() > 1.0 and np.median(mean) == pytest.approx(0.1, rel=1e-3)
