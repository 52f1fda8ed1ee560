"""The mixture of noisy and denoised picture: never worse, and the truth in the end."""

import math
import sys

import numpy as np
import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.image import denoise
from bokehguide.render.split_film import relative_error
from bokehguide.train import RenderLoop, RenderSettings, denoising
from tests.support import scenes

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
    assert mixed.weights[0][detail].mean() < 0.1


def test_error_terms_are_unbiased():
    """With a linear filter for the denoiser, whose terms have known means: z-tests of sums over 200 pictures."""
    share, noise = 0.25, 0.3

    def filtered(picture: np.ndarray) -> np.ndarray:
        return 0.6 * picture + 0.4 * np.roll(picture, 1, 1)

    variance, bias = (noise * truth()) ** 2, filtered(truth()) - truth()
    gain, removed = 0.4 * variance, 0.16 * (variance + np.roll(variance, 1, 1))
    expected = [float(x.mean()) for x in (gain, removed + bias**2, variance)]
    found = []
    for seed in range(200):
        random = np.random.default_rng(seed)
        first, second = (
            truth() * (1.0 + noise / np.sqrt(part) * random.normal(size=(HEIGHT, WIDTH, 1))) for part in (share, 1.0 - share)
        )
        terms = denoise.error_terms([first, second, filtered(first), filtered(second)], np.full((HEIGHT, WIDTH), share))
        found.append([term.mean() for term in terms])
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert (error < 0.005 * np.array(expected)).all()
    assert (np.abs(np.mean(found, axis=0) - expected) < 4.0 * error).all()


def test_the_standard_error_of_the_gain_is_its_spread_over_pictures():
    """Independent pixels, and a denoiser that removes all noise."""
    random, half = np.random.default_rng(7), np.full((HEIGHT, WIDTH), 0.5)
    gains, errors = [], []
    for _ in range(100):
        first, second = (random.exponential(size=(HEIGHT, WIDTH, 1)) for _ in "ab")
        gain, _, _ = denoise.error_terms([first, second, np.ones_like(first), np.ones_like(first)], half)
        gains.append(denoise.windowed(gain)), errors.append(denoise.standard_error(gain) ** 2)
    inner = np.s_[12:-12, 12:-12]
    spread = np.var(gains, axis=0)[inner].mean()
    assert np.sqrt(np.mean(errors, axis=0)[inner].mean()) == pytest.approx(np.sqrt(spread), rel=0.03)


def test_rare_bright_samples_leave_few_specks(monkeypatch):
    """A perfect denoiser, and noise as of a small glint after a few samples: without the doubt, 7 % of the noise would remain."""
    monkeypatch.setattr(denoise, "Denoiser", lambda *_: lambda picture: np.full(picture.shape, 0.5, np.float32))
    random = np.random.default_rng(11)
    first, second = (np.full(FLAT.shape, 0.25) * random.exponential(size=(HEIGHT, WIDTH, 1)) ** 2 for _ in "ab")
    mixed = denoise.denoise_halves(first.astype(np.float32), second.astype(np.float32), SHARE, FLAT, FLAT)
    assert np.abs(mixed.radiance - 0.5).mean() < 0.01 * np.abs(0.5 * (first + second) - 0.5).mean()


@pytest.mark.parametrize("bias", [0.0, 0.5])
def test_the_chance_error_is_the_spread_of_the_evidence_over_pictures(bias):
    """Gaussian noise of independent pixels, and a denoiser that gives the truth and a bias."""
    random, half = np.random.default_rng(8), np.full((HEIGHT, WIDTH), 0.5)
    clean, variance, evidence, errors = np.full((HEIGHT, WIDTH, 1), bias), np.full((HEIGHT, WIDTH, 1), 0.5 * 0.3**2), [], []
    for _ in range(100):
        first, second = (0.3 * random.normal(size=(HEIGHT, WIDTH, 1)) for _ in "ab")
        gain, _, _ = denoise.error_terms([first, second, clean, clean], half)
        change = (clean - 0.5 * (first + second)) ** 2
        evidence.append(denoise.windowed(change - gain)), errors.append(denoise.chance_error(change, variance) ** 2)
    inner = np.s_[12:-12, 12:-12]
    spread = np.var(evidence, axis=0)[inner].mean()
    assert np.sqrt(np.mean(errors, axis=0)[inner].mean()) == pytest.approx(np.sqrt(spread), rel=0.05)


def one_bright_pixel() -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Halves of an even picture with little noise that agree in a single bright pixel, and the pixel."""
    random, place = np.random.default_rng(15), (30, 40)
    first, second = (0.5 + 0.02 * random.normal(size=(HEIGHT, WIDTH, 1)) * np.ones(3) for _ in "ab")
    first[place], second[place] = 7.0, 5.0
    return first.astype(np.float32), second.astype(np.float32), place


def test_a_bright_sample_in_both_halves_of_a_pixel_is_noise(monkeypatch):
    """One bright sample of four in each half: the window is denoised. Without the variance, its noise would remain."""
    monkeypatch.setattr(denoise, "Denoiser", lambda *_: lambda picture: np.full(picture.shape, 0.5, np.float32))
    first, second, place = one_bright_pixel()
    variance = np.full((HEIGHT, WIDTH), 0.5 * 0.02**2)
    bright = np.array([4.0 * 7.0, 4.0 * 5.0])
    variance[place] = (np.sum(bright**2) / 8.0 - (np.sum(bright) / 8.0) ** 2) / 7.0
    around = np.s_[place[0] - 4 : place[0] + 5, place[1] - 4 : place[1] + 5]
    weights = [denoise.denoise_halves(first, second, SHARE, FLAT, FLAT, (), v).weights[0][around] for v in (variance, None)]
    assert weights[0].min() > 0.95 and weights[1].min() < 0.1


def test_a_pixel_whose_samples_are_all_bright_keeps_its_light(monkeypatch):
    monkeypatch.setattr(denoise, "Denoiser", lambda *_: lambda picture: np.full(picture.shape, 0.5, np.float32))
    first, second, place = one_bright_pixel()
    mixed = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT, (), np.full((HEIGHT, WIDTH), 0.02**2))
    assert mixed.radiance[place].min() > 5.5


def test_the_bias_of_the_denoiser_is_in_the_error_ratio(monkeypatch):
    """A denoiser without noise, whose pictures are a tenth too bright: both halves agree, and are wrong."""
    monkeypatch.setattr(denoise, "Denoiser", lambda *_: lambda picture: np.full(picture.shape, 0.55, np.float32))
    random = np.random.default_rng(12)
    first, second = (0.5 + 0.05 * random.normal(size=(HEIGHT, WIDTH, 1)) * np.ones(3) for _ in "ab")
    mixed = denoise.denoise_halves(first.astype(np.float32), second.astype(np.float32), SHARE, FLAT, FLAT)
    noisy = np.abs(0.5 * (first + second) - 0.5).mean(-1)
    assert (noisy * mixed.error_ratio).mean() == pytest.approx(np.abs(mixed.radiance - 0.5).mean(), rel=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.4, 0.1, 0.02])
def test_the_error_ratio_is_that_of_many_pictures(noise):
    """The mean absolute error of the mixture by that of the noisy picture, which the ratio estimates within a fifth."""
    sums = np.zeros(3)
    for seed in range(4):
        first, second = halves(noise, seed)
        mixed = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT)
        noisy = np.abs(0.5 * (first + second) - truth()).mean(-1)
        sums += [np.abs(mixed.radiance - truth()).mean(), noisy.mean(), (noisy * mixed.error_ratio).mean()]
    assert sums[2] == pytest.approx(sums[0], abs=0.2 * sums[1])
    assert sums[2] < 0.9 * sums[1]


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_the_error_ratio_is_the_part_of_the_noise_that_is_left(share):
    """Mixtures without bias that keep 40 % of the noise of halves with different shares."""
    random, kept = np.random.default_rng(16), 0.4
    noise = [0.3 / np.sqrt(part) * random.normal(size=(HEIGHT, WIDTH, 1)) for part in (share, 1.0 - share)]
    pictures = [1.0 + part * values for part in (1.0, kept) for values in noise]
    ratio = denoise.error_ratio(pictures, np.full((HEIGHT, WIDTH), share))
    assert ratio.mean() == pytest.approx(kept, rel=0.05)


def test_the_estimated_error_of_a_denoised_picture_is_the_noise_times_the_ratio(monkeypatch):
    quarter = np.full((20, 32), 0.25)
    monkeypatch.setattr(denoising, "denoise_halves", lambda first, *_: denoise.Denoised(first, quarter, quarter))
    with RenderLoop(scenes.emitters(32, 20), RenderSettings("uniform", threads=1, denoise=True)) as loop:
        for _ in range(4):
            loop.step()
    first, second = (half.permute(2, 0, 1) for half in loop.film.halves()[:2])
    noise = float(relative_error(first, second, 0.75).mean())  # steps 1, 3 and 4, and step 2
    assert noise > 0.0 and denoising.denoise_picture(loop.film).estimated_mape == pytest.approx(0.25 * noise)


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_the_relative_error_of_a_mean_of_unequal_halves(share):
    random = torch.Generator().manual_seed(1)
    halves = [1.0 + 0.01 / math.sqrt(part) * torch.randn(3, 64, 64, generator=random) for part in (share, 1.0 - share)]
    errors = (share * halves[0] + (1.0 - share) * halves[1] - 1.0).abs()
    estimated = relative_error(*halves, torch.full((64, 64), share))
    assert float(estimated.mean()) == pytest.approx(float(errors.mean()) / 1.01, rel=0.02)


def test_rare_bright_pixels_do_not_hide_the_error_of_the_others(monkeypatch):
    """A denoiser that removes bright pixels and nothing else: the others keep their errors, and so does the estimate."""
    monkeypatch.setattr(denoise, "Denoiser", lambda *_: lambda picture: picture.clip(max=0.8))
    base, random = np.full((HEIGHT, WIDTH, 3), 0.5), np.random.default_rng(3)
    first, second = (
        base + 0.05 * random.normal(size=(HEIGHT, WIDTH, 1)) + 50.0 * (random.uniform(size=(HEIGHT, WIDTH, 1)) < 0.01)
        for _ in "ab"
    )
    mixed = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT)
    noisy = np.abs(0.5 * (first + second) - base).mean(-1)
    ordinary = noisy < 1.0
    left = np.abs(mixed.radiance - base).mean(-1)
    assert (noisy * mixed.error_ratio)[ordinary].mean() == pytest.approx(left[ordinary].mean(), rel=0.2)


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


def correlated(noise: float) -> np.ndarray:
    """A picture whose pixels share their noise in groups of 2 × 2."""
    random = np.random.default_rng(1).normal(size=(HEIGHT // 2, WIDTH // 2, 1)).repeat(2, 0).repeat(2, 1)
    return (truth() * (1.0 + noise * random)).astype(np.float32)


@pytest.mark.parametrize("noise", [0.4, 0.1, 0.02, 0.005])
def test_by_variance_it_is_not_worse_either(noise):
    independent = (truth() * (1.0 + noise * np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, 1)))).astype(np.float32)
    variance = ((truth()[..., 0] * noise) ** 2).astype(np.float32)
    for noisy in (independent, correlated(noise)):
        mixed = denoise.denoise_by_variance(noisy, variance, FLAT, FLAT)
        assert error(mixed.radiance) < error(noisy)
        assert mixed.error_ratio is None


def test_by_variance_noise_that_the_denoiser_keeps_lowers_the_weight(monkeypatch):
    """A linear filter on a flat picture: C = 0.2 V and Q = 1.28 V, so that the weight is 0.6 / 1.28."""
    monkeypatch.setattr(denoise, "Denoiser", lambda *_: lambda picture: 0.2 * picture + 0.8 * np.roll(picture, 10, 1))
    noisy = 0.5 + 0.1 * np.random.default_rng(2).normal(size=(HEIGHT, WIDTH, 1)) * np.ones(3)
    mixed = denoise.denoise_by_variance(noisy, np.full((HEIGHT, WIDTH), 0.01), FLAT, FLAT)
    assert mixed.weights.mean() == pytest.approx(0.6 / 1.28, abs=0.03)


def test_without_the_package_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(BokehguideError, match=r"pip install 'bokehguide\[denoise\]'"):
        denoise.Denoiser(FLAT, FLAT)


class TwoDenoisers:
    """In place of `Denoiser`: a picture of 0.4 with layers, and a picture of 0.6 without."""

    def __init__(self, *layers):
        self._value = 0.4 if layers else 0.6

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        return np.full(picture.shape, self._value, np.float32)


def test_the_denoised_picture_is_the_mean_of_two_denoisers(monkeypatch):
    monkeypatch.setattr(denoise, "Denoiser", TwoDenoisers)
    monkeypatch.setattr(denoise, "mixing_weight", lambda gain, change: np.ones_like(gain))
    first, second = halves(0.2)
    by_halves = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT)
    by_variance = denoise.denoise_by_variance(first, np.full((HEIGHT, WIDTH), 0.04), FLAT, FLAT)
    for mixed in (by_halves, by_variance):
        np.testing.assert_allclose(mixed.radiance, 0.5, rtol=1e-6)


def test_the_denoiser_without_layers_gets_the_mirrored_picture(monkeypatch):
    """A denoiser that moves pictures one row down: mirrored, it moves them up."""
    monkeypatch.setattr(denoise, "Denoiser", lambda *layers: lambda x: x if layers else np.roll(x, 1, 0))
    x = np.random.default_rng(4).uniform(size=(HEIGHT, WIDTH, 3))
    np.testing.assert_array_equal(denoise.mirrored(denoise.Denoiser())(x), np.roll(x, -1, 0))
    assert denoise.denoise_halves(x, x, SHARE, FLAT, FLAT).weights.max() == 0.0


def disc() -> np.ndarray:
    """A bright disc, as an emitter out of focus."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.where((x - 30) ** 2 + (y - 30) ** 2 < 18**2, 2.0, 0.0)[..., None] * np.ones(3)


def lit(seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Halves of a picture of an emitter with little noise and of reflected light with much noise; halves of the emitter."""
    random = np.random.default_rng(seed)
    seen = [disc() * (1.0 + 0.02 * random.normal(size=(HEIGHT, WIDTH, 1))) for _ in "ab"]
    reflected = [0.5 * random.exponential(size=(HEIGHT, WIDTH, 1)) ** 2 * np.ones(3) for _ in "ab"]
    return [(x + y).astype(np.float32) for x, y in zip(seen, reflected)], [half.astype(np.float32) for half in seen]


def test_emission_is_denoised_apart_from_reflected_light():
    """The error of the picture with the halves of the emission is less than without them."""
    errors = []
    for seed in range(3):
        halves_, seen = lit(seed)
        apart = denoise.denoise_halves(*halves_, SHARE, FLAT, FLAT, seen)
        joint = denoise.denoise_halves(*halves_, SHARE, FLAT, FLAT)
        assert apart.weights.shape == (2, HEIGHT, WIDTH) and joint.weights.shape == (1, HEIGHT, WIDTH)
        errors.append([np.abs(mixed.radiance - 1.0 - disc()).mean() for mixed in (apart, joint)])
    apart, joint = np.mean(errors, 0)
    assert apart < 0.9 * joint


def test_emission_is_denoised_without_layers(monkeypatch):
    monkeypatch.setattr(denoise, "Denoiser", TwoDenoisers)
    monkeypatch.setattr(denoise, "mixing_weight", lambda gain, change: np.ones_like(gain))
    halves_, seen = lit(2)
    np.testing.assert_allclose(denoise.denoise_halves(*halves_, SHARE, FLAT, FLAT, seen).radiance, 0.5 + 0.6, rtol=1e-6)


@pytest.mark.parametrize("without", [(), (np.zeros_like(FLAT), np.zeros_like(FLAT))])
def test_a_picture_without_emission_has_one_part(without):
    first, second = halves(0.2)
    expected = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT)
    found = denoise.denoise_halves(first, second, SHARE, FLAT, FLAT, without)
    np.testing.assert_array_equal(found.radiance, expected.radiance)
    assert len(found.weights) == 1


def test_the_error_ratio_counts_both_parts(monkeypatch):
    """Denoisers that remove all noise of each part: the sum of both parts has almost no error."""
    monkeypatch.setattr(denoise, "Denoiser", lambda *_: lambda x: np.full(x.shape, x.mean(), np.float32))
    random = np.random.default_rng(14)
    seen, reflected = ([mean * (1.0 + 0.3 * random.normal(size=FLAT.shape)) for _ in "ab"] for mean in (0.4, 0.6))
    halves_ = [x + y for x, y in zip(seen, reflected)]
    mixed = denoise.denoise_halves(*halves_, SHARE, FLAT, FLAT, seen)
    assert np.abs(mixed.radiance - 1.0).mean() < 0.05 * np.abs(np.mean(halves_, 0) - 1.0).mean()
    assert mixed.error_ratio.mean() < 0.15


def test_one_half_alone_is_denoised_in_its_parts():
    (first, _), (seen, _) = lit(0)
    none = np.zeros_like(first)
    mixed = denoise.denoise_halves(first, none, np.ones_like(SHARE), FLAT, FLAT, (seen, none))
    reflected = first.astype(np.float64) - seen.astype(np.float64)
    expected = denoise.Denoiser(FLAT, FLAT)(reflected) + denoise.mirrored(denoise.Denoiser())(seen)
    np.testing.assert_allclose(mixed.radiance, expected, rtol=1e-5)


def test_emission_that_is_not_finite_spoils_no_others():
    halves_, seen = lit(1)
    seen[0][3, 4] = np.nan
    mixed = denoise.denoise_halves(*halves_, SHARE, FLAT, FLAT, seen)
    assert np.isfinite(mixed.radiance).all() and np.isfinite(mixed.error_ratio).all()
