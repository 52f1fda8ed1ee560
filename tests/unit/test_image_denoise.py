"""The mixture of noisy and denoised picture: never worse, and the truth in the end."""

import sys

import numpy as np
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.image import denoise

oidn = pytest.importorskip("mitsuba_oidn")
HEIGHT, WIDTH = 64, 96
FLAT = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
SHARE = np.full((HEIGHT, WIDTH), 0.5, np.float32)


def truth() -> np.ndarray:
    """A smooth half, and a half of fine detail, which a denoiser takes for noise."""
    detail = np.random.default_rng(0).uniform(0.1, 1.0, (HEIGHT, WIDTH, 1))
    smooth = np.linspace(0.2, 0.8, HEIGHT)[:, None, None]
    return np.where(np.arange(WIDTH)[:, None] < WIDTH // 2, smooth, detail) * np.ones(3)


def halves(noise: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return tuple((truth() * (1.0 + noise * random.normal(size=(HEIGHT, WIDTH, 1)))).astype(np.float32) for _ in "ab")


def error(picture: np.ndarray) -> float:
    return float(np.sqrt(((picture - truth()) ** 2).mean()))


@pytest.mark.parametrize("noise", [0.8, 0.2, 0.05, 0.0125])
def test_never_worse_than_the_noisy_picture_and_than_the_denoised_one(noise):
    first, second = halves(noise)
    mixed = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT)
    noisy, clean = 0.5 * (first + second), denoise.Denoiser(FLAT, FLAT)(0.5 * (first + second))
    assert error(mixed.radiance) < error(noisy)
    assert error(mixed.radiance) < 1.02 * error(clean)
    assert mixed.radiance.dtype == np.float32 and mixed.radiance.shape == (HEIGHT, WIDTH, 3)


def test_the_picture_tends_to_the_truth_where_the_denoiser_does_not():
    first, second = halves(1e-3)
    mixed = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT)
    detail = np.s_[4:-4, WIDTH // 2 + 12 : -4]
    clean = denoise.Denoiser(FLAT, FLAT)(0.5 * (first + second))
    assert np.abs(clean - truth())[detail].mean() > 10.0 * np.abs(mixed.radiance - truth())[detail].mean()
    assert mixed.weight[detail].mean() < 0.1


def test_the_estimated_errors_are_those_of_many_pictures(monkeypatch):
    """With a linear filter for the denoiser: V - 2 w G + w² Q against the squared error itself, averaged over pictures."""
    monkeypatch.setattr(denoise, "Denoiser", lambda *_: lambda picture: 0.5 * (picture + np.roll(picture, 1, 1)))
    sums = np.zeros(2)
    for seed in range(40):
        first, second = halves(0.3, seed)
        mixed = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT)
        noisy, interior = 0.5 * (first + second), np.s_[4:-4, 4:-4]
        level = (truth().mean(-1) + denoise.FLOOR) ** 2
        gain = [((picture - truth()) ** 2).mean(-1) / level for picture in (mixed.radiance, noisy)]
        sums += [gain[0][interior].mean(), (mixed.error_ratio**2 * gain[1])[interior].mean()]
    assert sums[1] == pytest.approx(sums[0], rel=0.25)  # the weight suits the noise that it is measured by


def test_unequal_halves_have_their_shares():
    random, base = np.random.default_rng(5), np.full((HEIGHT, WIDTH, 3), 0.5)
    first = (base + 0.2 * random.normal(size=(HEIGHT, WIDTH, 1))).astype(np.float32)
    second = (base + 0.02 * random.normal(size=(HEIGHT, WIDTH, 1))).astype(np.float32)
    share = np.full((HEIGHT, WIDTH), 1.0 / 101.0, np.float32)
    mixed = denoise.denoise_halves(first, second, share, FLAT, FLAT)
    noisy = share[..., None] * first + (1.0 - share[..., None]) * second
    assert np.abs(mixed.radiance - base).mean() < 0.8 * np.abs(noisy - base).mean()


def test_one_half_alone_is_denoised():
    first, _ = halves(0.5)
    mixed = denoise.denoise_halves(first, np.zeros_like(first), np.ones_like(SHARE), FLAT, FLAT)
    np.testing.assert_array_equal(mixed.radiance, denoise.Denoiser(FLAT, FLAT)(first))
    assert mixed.error_ratio is None


def test_pixels_that_are_not_finite_spoil_no_others():
    first, second = halves(0.2)
    first[10, 20], second[30, 40], albedo = np.nan, np.inf, FLAT.copy()
    albedo[5, 5] = np.nan
    mixed = denoise.denoise_halves(first, second, SHARE, albedo, FLAT)
    assert np.isfinite(mixed.radiance).all() and np.isfinite(mixed.error_ratio).all()
    far = np.s_[40:, :]
    spared = denoise.denoise_halves(*halves(0.2), SHARE, FLAT, FLAT)
    assert np.abs(mixed.radiance - spared.radiance)[far].mean() < 0.02


@pytest.mark.parametrize("noise", [0.4, 0.02])
def test_by_variance_it_is_not_worse_either(noise):
    first, second = halves(noise)
    noisy = 0.5 * (first + second)
    variance = ((truth()[..., 0] * noise) ** 2 / 2).astype(np.float32)
    assert error(denoise.denoise_by_variance(noisy, variance, FLAT, FLAT).radiance) < error(noisy)


def test_without_the_package_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(BokehguideError, match=r"pip install 'bokehguide\[denoise\]'"):
        denoise.Denoiser(FLAT, FLAT)
