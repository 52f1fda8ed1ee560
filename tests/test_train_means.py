"""What is rendered is right on average, guided or not, learnt or learning."""

import numpy as np
import pytest
from render_checks import FINER_SPP, REFERENCE_SPP, furnace, frozen, learning, means_check, one_everywhere, uniform_reference
from statistical import SIGNIFICANCE

from bokehguide.train import LENS_MODES

GUIDED = LENS_MODES[1:]


def reference_spp(mode: str) -> int:
    return FINER_SPP if mode == "guided" else REFERENCE_SPP


@pytest.mark.parametrize("mode", LENS_MODES)
def test_furnace_comes_out_one(mode):
    """In every pixel within its noise, and the frame within half a percent."""
    found = furnace(mode, controlled=False)
    assert one_everywhere(found) > SIGNIFICANCE
    assert found.mean.mean() == pytest.approx(1.0, abs=0.005)
    if mode == "uniform":
        np.testing.assert_allclose(found.mean, 1.0, atol=1e-5)
    else:
        # The guide was at work, even where β has learnt to do without it; `guided` cuts its discs off at the lens.
        assert found.last.outside > (0.003 if mode == "guided" else 0.01)
        assert (found.variance > 1e-5).mean() > 0.5


def test_with_the_weights_as_a_control_variate_hardly_any_noise_is_left():
    """In the furnace all of it is theirs; in every pixel the mean is 1 within what is left."""
    found, noisy = furnace("guided"), furnace("guided", controlled=False)
    assert one_everywhere(found) > SIGNIFICANCE
    assert found.mean.mean() == pytest.approx(1.0, abs=5e-4)
    assert found.variance.mean() < 0.02 * noisy.variance.mean()


@pytest.mark.parametrize("mode", GUIDED)
def test_means_while_learning_are_those_of_the_uniform_lens(mode):
    found = learning(mode)
    assert found.last.gaussians > 0 and found.last.outside > 0.05
    assert means_check(found, reference_spp(mode)) > SIGNIFICANCE


@pytest.mark.parametrize("mode", GUIDED)
def test_means_of_what_was_learnt_are_those_of_the_uniform_lens(mode):
    found = frozen(mode)
    assert found.last.gaussians > 0 and found.last.outside > 0.05
    assert means_check(found, reference_spp(mode)) > SIGNIFICANCE


def test_reference_sees_the_lamps():
    mean = uniform_reference().mean
    assert mean.max() > 1.0 and np.median(mean) == pytest.approx(0.1, rel=1e-3)
