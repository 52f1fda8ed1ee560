"""Metering: grey cards, noise, lamps, alpha."""

import numpy as np
import pytest

from bokehguide.image import metered_exposure
from bokehguide.image.exposure import HIGHLIGHTS, KEY


def card(radiance: float, width: int = 320, height: int = 180) -> np.ndarray:
    return np.full((height, width, 3), radiance, np.float32)


@pytest.mark.parametrize("radiance", [1e-6, 0.01, 0.18, 5.0, 1e12])
def test_an_even_picture_becomes_middle_grey(radiance):
    assert metered_exposure(card(radiance)) == pytest.approx(np.log2(KEY / radiance), abs=0.006)


def test_noise_fireflies_and_tiny_lamps_hardly_matter():
    random = np.random.default_rng(3)
    clean = card(0.1) * random.uniform(0.3, 1.0, (180, 1, 1)).astype(np.float32)
    exposure = metered_exposure(clean)
    noisy = clean * random.exponential(1.0, (180, 320, 1))
    noisy[random.integers(180, size=20), random.integers(320, size=20)] = 1e5  # of all light, nearly the whole
    assert metered_exposure(noisy) == pytest.approx(exposure, abs=0.15)
    assert np.log2(clean.mean() / noisy.mean()) < -6.0  # a mean would fail


def test_a_bokeh_disc_limits_the_exposure():
    picture = card(0.02)
    picture[40:100, 100:180] = 32.0  # a twelfth of the frame
    assert np.log2(HIGHLIGHTS / 32.0) - 1.0 < metered_exposure(picture) <= np.log2(HIGHLIGHTS / 32.0)


def test_emitters_do_not_darken_the_rest():
    picture = card(0.2)
    exposure = metered_exposure(picture)
    picture[40:100, 100:180] = 3.0  # below the limit of the highlights
    assert metered_exposure(picture) == pytest.approx(exposure, abs=0.02)


def test_surroundings_without_alpha_do_not_count():
    picture, alpha = card(0.0), np.zeros((180, 320), np.float32)
    picture[:, :20], alpha[:, :20] = 0.25 * 0.5, 0.5  # premultiplied
    assert metered_exposure(picture, alpha) == pytest.approx(np.log2(KEY / 0.25), abs=0.02)


def test_black_surroundings_are_not_brightened():
    picture = card(1e-5)
    picture[60:120, 100:200] = 0.5
    assert 0.0 < metered_exposure(picture) < np.log2(HIGHLIGHTS / 0.5) - 0.5  # a log mean without bound: the limit


def test_black_tiny_and_broken_pictures_have_an_exposure():
    assert metered_exposure(card(0.0)) == 0.0
    assert metered_exposure(card(np.nan, 3, 2)) == 0.0
    assert metered_exposure(card(0.18, 1, 1)) == pytest.approx(np.log2(KEY / 0.18), abs=0.006)
    lone = card(0.0)
    lone[5, 5] = 100.0
    assert np.isfinite(metered_exposure(lone))
