"""Denoising that is not worse than the noisy picture: a mixture of both, by errors that two halves estimate.

A picture N = s A + (1 - s) B has halves A and B. The delivered picture is N + w (D(N) - N), where D(N) is the denoised picture
and w the weight of the denoiser. The denoised halves, D = s D(A) + (1 - s) D(B), tell the weight, because the other half is an
unbiased witness for each of them. The squared error of N + w (D - N) is V - 2 w G + w² Q with

    V = E (N - T)²,  G = E (T - N)(D - N),  Q = E (D - N)²,

where T is the truth. The halves have the mean T. For uncorrelated noise of A and B, sums over pixels estimate without bias

    V by s (1 - s) (A - B)²,  G by s² (A - B)(A - D(A)) + (1 - s)² (B - A)(B - D(B)),  Q by (D - N)².

V's estimate takes the variance of a half to be inversely proportional to its samples. w = G / Q has the least error. With more
samples G falls as 1 / samples and Q tends to the squared bias of the denoiser, so that the mixture tends to the truth. D(N) is
used for D(A) and D(B) because a denoiser works better on all samples than on half of the samples. Sums have Gaussian windows and
are relative to the brightness, as MAPE is. (Squared errors from noisy pictures alone: Stein 1981; from two halves: Rousselle,
Knaus and Zwicker 2012.)

A window has few pixels, and noise with rare bright samples makes the estimate of G uncertain. Where this noise lowers w, specks
of the noisy picture remain. The weight is therefore (G + DOUBT · its standard error) / Q. The standard error falls with the
noise, so that the mixture still tends to the truth.

Bright samples that fall into both halves of a pixel by chance agree, and look like light that the denoiser removes. The
variance of the pixel's samples tells chance from light. For noise of variance v, the evidence (D - N)² - G of a pixel against
the denoiser has the variance 4 E (D - N)² v: 4 b² v + 4 v² for a bias b. Its standard error over the window counts in place of
that of G where it is larger. Samples of the emission that the lens sees are stratified well, and their variance tells little.

D(N) is the mean of two denoisers: with auxiliary layers, and without them on the mirrored picture. Their errors differ, so that
the mean has less error (an ensemble, as of Zheng et al. 2021). The second denoiser also denoises the halves.

Light that the lens sees directly from emitters is denoised apart from reflected light. Mode `guided` samples this emission with
little noise, and the noise of reflected light would blur the edges of its circles of confusion. Albedo and normal tell nothing
about emission, so that the denoiser without layers denoises it.

The reported error is a mean absolute error, and a few bright pixels dominate squared errors. The ratio of errors therefore
comes from compressed pictures, tanh(A / brightness) (see `error_ratio`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.image.oidn import Denoiser

WINDOW = 3.0
"""Standard deviation in pixels of the windows over which errors are averaged."""
PIXELS = 4.0 * np.pi * WINDOW**2
"""Independent pixels in a window: the inverse of the sum of its squared weights."""
LEVEL_WINDOW = 1.5
"""As WINDOW, of the brightness that errors are relative to."""
FLOOR = 0.01
"""Added to the brightness, as in MAPE."""
DOUBT = 2.0
"""Standard errors of an estimate beyond which evidence against the denoiser counts."""
PROBE = 0.5
"""Standard deviation of the noise that is added to a picture without halves, by that of the picture's noise."""
LEAST = 1e-20

Filter = Callable[[np.ndarray], np.ndarray]
"""A denoiser of pictures `[H, W, 3]`."""


class Denoised(NamedTuple):
    """A denoised picture.

    radiance: float32 `[H, W, 3]`; weights: of the denoiser in each of P parts of the picture, 0 to 1, float32 `[P, H, W]`;
    error_ratio: estimated error by that of the noisy picture, 0 to 1, float32 `[H, W]`, None for a picture without two halves.
    """

    radiance: np.ndarray
    weights: np.ndarray
    error_ratio: np.ndarray | None


class _Part(NamedTuple):
    """A part of the light of a picture, in two halves.

    halves: `[H, W, 3]` each. noisy: their mean by their shares, `[H, W, 3]`. clean: the denoised mean, `[H, W, 3]`. variance: of
    the mean luminance by its samples, `[H, W]`; None where it is unknown.
    """

    halves: Sequence[np.ndarray]
    noisy: np.ndarray
    clean: np.ndarray
    variance: np.ndarray | None = None


def denoise_halves(
    first: np.ndarray,
    second: np.ndarray,
    share: np.ndarray,
    albedo: np.ndarray,
    normal: np.ndarray,
    emission: Sequence[np.ndarray] = (),
    variance: np.ndarray | None = None,
) -> Denoised:
    """The mixture for two halves `[H, W, 3]`, of which the first has the weight `share` `[H, W]` in the picture.

    albedo, normal: layers of the picture, `[H, W, 3]`. emission: the part of both halves that the lens sees directly from
    emitters, `[H, W, 3]` each; none counts as black. variance: of the mean luminance by its samples, `[H, W]`. A picture without
    a second half, as after one sample, is the denoised one alone, by one denoiser for each part. Raises BokehguideError where
    Open Image Denoise is not installed.
    """
    both = bool(((share > 0.0) & (share < 1.0)).any())
    with_layers, plain = Denoiser(albedo, normal), mirrored(Denoiser())
    halves = finite_pixels(first), finite_pixels(second)

    def part(halves: Sequence[np.ndarray], *denoisers: Filter) -> _Part:
        noisy = share[..., None] * halves[0] + (1.0 - share[..., None]) * halves[1]
        clean = np.mean([denoiser(noisy) for denoiser in denoisers[: None if both else 1]], 0)
        return _Part(halves, noisy, clean)

    seen = [finite_pixels(half) for half in emission]
    if any(half.any() for half in seen):
        parts = [part([half - its for half, its in zip(halves, seen)], with_layers, plain), part(seen, plain)]
    else:
        parts = [part(halves, with_layers, plain)]
    parts[0] = parts[0]._replace(variance=None if variance is None else finite_pixels(variance))
    if not both:
        return Denoised(np.sum([part.clean for part in parts], 0), np.ones((len(parts), *share.shape), np.float32), None)
    return _mixed(parts, halves, share, plain)


def _mixed(parts: Sequence[_Part], halves: Sequence[np.ndarray], share: np.ndarray, denoiser: Filter) -> Denoised:
    """The sum of the mixtures of all parts of a picture. The denoiser denoises the halves."""
    level = brightness(np.sum([part.clean for part in parts], 0))
    weights, mixed_halves = [], np.zeros((2, *level.shape[:2], 3))
    for part in parts:
        clean = [denoiser(half) for half in part.halves]
        gain, change, _ = error_terms([picture / level for picture in (*part.halves, *clean)], share)
        doubt = DOUBT * standard_error(gain)
        if part.variance is not None:
            doubt = np.maximum(doubt, chance_error(change, part.variance[..., None] / level**2))
        weights.append(mixing_weight(windowed(gain) + doubt, windowed(change)))
        mixed_halves += [mixture(*pair, weights[-1]) for pair in zip(part.halves, clean)]
    ratio = error_ratio([np.tanh(picture / level) for picture in (*halves, *mixed_halves)], share)
    mixed = np.sum([mixture(part.noisy, part.clean, weight) for part, weight in zip(parts, weights)], 0)
    return Denoised(mixed, np.array(weights, np.float32), ratio.astype(np.float32))


def mirrored(denoiser: Filter) -> Filter:
    """A denoiser of pictures that are turned upside down before and after."""
    return lambda picture: denoiser(picture[::-1])[::-1]


def error_terms(pictures: Sequence[np.ndarray], share: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimates of G, Q and V in each pixel, `[H, W, C]`. pictures: A, B, D(A) and D(B), `[H, W, C]`; share: of A, `[H, W]`."""
    first, second, clean_first, clean_second = pictures
    s = share[..., None]
    both = (s > 0.0) & (s < 1.0)
    difference = np.where(both, first - second, 0.0)
    gain = s**2 * difference * (first - clean_first) - (1.0 - s) ** 2 * difference * (second - clean_second)
    change = np.where(both, s * (clean_first - first) + (1.0 - s) * (clean_second - second), 0.0)
    return gain, change**2, s * (1.0 - s) * difference**2


def error_ratio(pictures: Sequence[np.ndarray], share: np.ndarray) -> np.ndarray:
    """Estimated error of the delivered picture over that of the noisy one, 0 to 1, `[H, W]`.

    pictures: A, B and their mixtures, `[H, W, C]`; share: of A, `[H, W]`. The mixtures of both halves differ by their noise.
    Their shared error, the bias of the denoiser, is in V - 2 G + Q with the mixtures in place of D(A) and D(B). The estimate of
    this sum is uncertain. The bias counts as far as the sum exceeds the noise by more than DOUBT standard errors.
    """
    gain, change, variance = error_terms(pictures, share)
    s = share[..., None]
    noise = windowed(s * (1.0 - s) * (pictures[2] - pictures[3]) ** 2)
    error = variance - 2.0 * gain + change
    bias = (windowed(error) - noise - DOUBT * standard_error(error)).clip(min=0.0)
    return np.sqrt(((noise + bias) / windowed(variance).clip(min=LEAST)).clip(max=1.0))


def denoise_by_variance(beauty: np.ndarray, variance: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> Denoised:
    """The mixture for a picture without halves, by the estimated variance of its luminance, `[H, W]`.

    V is the variance. A second denoising, of the picture with small independent noise added, estimates the covariance C of D and
    N, so that G = V - C and E (D - T)² = Q - V + 2 C (Ramani, Blu and Unser 2008). The weight is 1 - E (D - T)² / Q, which is
    less than G / Q by C / Q: the noise of pixels that share samples is not independent, and the denoiser keeps more of it than of
    the added noise.
    """
    noisy, deviation = finite_pixels(beauty), np.sqrt(finite_pixels(variance).clip(min=0.0))[..., None]
    plain = mirrored(Denoiser())
    other = plain(noisy)
    clean = np.mean([Denoiser(albedo, normal)(noisy), other], 0)
    probe = deviation * np.random.default_rng(0).normal(size=deviation.shape)
    kept = (plain(noisy + PROBE * probe) - other) / PROBE
    level = brightness(clean)
    power, covariance = windowed((deviation / level) ** 2), windowed(probe * kept @ LUMINANCE[:, None] / level**2)
    change = windowed(((clean - noisy) @ LUMINANCE[:, None] / level) ** 2)
    weight = mixing_weight(power - 2.0 * covariance.clip(min=0.0), change)
    return Denoised(mixture(noisy, clean, weight), weight.astype(np.float32)[None], None)


def brightness(picture: np.ndarray) -> np.ndarray:
    """Smoothed luminance `[H, W, 1]` that errors are relative to."""
    from scipy.ndimage import gaussian_filter  # takes long to import, and most renders do not denoise

    return gaussian_filter((picture @ LUMINANCE).clip(min=0.0), LEVEL_WINDOW, mode="nearest")[..., None] + FLOOR


def windowed(values: np.ndarray) -> np.ndarray:
    """Means `[H, W]` of values `[H, W, C]` over channels and a Gaussian window."""
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(values.mean(-1), WINDOW, mode="nearest")


def standard_error(values: np.ndarray) -> np.ndarray:
    """Standard error `[H, W]` of `windowed` values `[H, W, C]` with independent pixels."""
    spread = windowed(values.mean(-1, keepdims=True) ** 2) - windowed(values) ** 2
    return np.sqrt(spread.clip(min=0.0) / PIXELS)


def chance_error(change: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Standard error `[H, W]` of the windowed evidence Q - G by the variance of the pixels' noise.

    change: (D - N)², `[H, W, C]`; variance: `[H, W, 1]`, relative to the same brightness.
    """
    return 2.0 * np.sqrt(windowed(change * variance) / PIXELS)


def mixing_weight(gain: np.ndarray, change: np.ndarray) -> np.ndarray:
    """G / Q within 0 and 1, of windowed G and Q, each `[H, W]`; 1 where the denoiser changes nothing."""
    return np.where(change > LEAST, (gain / change.clip(min=LEAST)).clip(0.0, 1.0), 1.0)


def mixture(noisy: np.ndarray, clean: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """N + w (D - N), float32 `[H, W, C]`, of images N and D `[H, W, C]` and weights w `[H, W]`."""
    return (noisy + weight[..., None] * (clean - noisy)).astype(np.float32)


def finite_pixels(image: np.ndarray) -> np.ndarray:
    """The image in double precision, of the same shape, with 0 for NaN and infinities."""
    return np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
