"""Denoising that is not worse than the noisy picture: a mixture of both, by errors that two halves estimate.

A picture N = s A + (1 - s) B has halves A and B with uncorrelated noise. The denoised picture is the mean of the denoised halves,
D = s D(A) + (1 - s) D(B). Pixels that share samples have correlated noise, of which a denoiser keeps a part as structure; the
part differs between the halves, and their mean has less of it than D(N).

The squared error of N + w (D - N) is V - 2 w G + w² Q with

    V = E (N - T)²,  G = E (T - N)(D - N),  Q = E (D - N)²,

where T is the truth. As A has the mean T and does not depend on the noise of B, sums over pixels estimate without bias

    V by s (1 - s) (A - B)²,  G by s² (A - B)(A - D(A)) + (1 - s)² (B - A)(B - D(B)),  Q by (D - N)².

V's estimate takes the variance of a half to be inversely proportional to its samples. w = G / Q has the least error. With more
samples G falls as 1 / samples and Q tends to the squared bias of the denoiser, so that the mixture tends to the truth. Sums have
Gaussian windows and are relative to the brightness, as MAPE is. (Squared errors from noisy pictures alone: Stein 1981; from two
halves: Rousselle, Knaus and Zwicker 2012.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.image.oidn import Denoiser

WINDOW = 3.0
"""Standard deviation in pixels of the windows over which errors are averaged."""
LEVEL_WINDOW = 1.5
"""As WINDOW, of the brightness that errors are relative to."""
FLOOR = 0.01
"""Added to the brightness, as in MAPE."""
LEAST = 1e-20


class Denoised(NamedTuple):
    """A denoised picture.

    radiance: float32 `[H, W, 3]`; weight: of the denoiser in it, 0 to 1, float32 `[H, W]`; error_ratio: estimated error by that
    of the noisy picture, 0 to 1, float32 `[H, W]`, None where only one half has samples.
    """

    radiance: np.ndarray
    weight: np.ndarray
    error_ratio: np.ndarray | None


def denoise_halves(first: np.ndarray, second: np.ndarray, share: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> Denoised:
    """The mixture for two halves `[H, W, 3]`, of which the first has the weight `share` `[H, W]` in the picture.

    albedo, normal: layers of the picture, `[H, W, 3]`. A picture without a second half, as after one sample, is the denoised one
    alone. Raises BokehguideError where Open Image Denoise is not installed.
    """
    s = share[..., None]
    one, two = finite_pixels(first), finite_pixels(second)
    noisy = s * one + (1.0 - s) * two
    denoiser = Denoiser(albedo, normal)
    if not ((share > 0.0) & (share < 1.0)).any():
        return Denoised(denoiser(noisy), np.ones_like(share), None)
    clean_one, clean_two = denoiser(one), denoiser(two)
    clean = s * clean_one + (1.0 - s) * clean_two
    both = (s > 0.0) & (s < 1.0)
    gain = s**2 * (one - two) * (one - clean_one) + (1.0 - s) ** 2 * (two - one) * (two - clean_two)
    change, variance = (clean - noisy) ** 2, s * (1.0 - s) * (one - two) ** 2
    sums = windowed([np.where(both, x, 0.0) for x in (gain, change, variance)], clean)
    weight = mixing_weight(sums[0], sums[1])
    error = sums[2] - 2.0 * weight * sums[0] + weight**2 * sums[1]
    ratio = np.sqrt((error.clip(min=0.0) / sums[2].clip(min=LEAST)).clip(max=1.0))
    return Denoised(mixture(noisy, clean, weight), weight.astype(np.float32), ratio.astype(np.float32))


def denoise_by_variance(beauty: np.ndarray, variance: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> Denoised:
    """The mixture for a picture without halves, by the estimated variance of its luminance, `[H, W]`.

    G is taken to be V: the denoised picture's own noise counts as none. At few samples the variance is a poor estimate, and so is
    the weight.
    """
    noisy = finite_pixels(beauty)
    clean = Denoiser(albedo, normal)(noisy)
    light = ((clean - noisy) @ LUMINANCE)[..., None] ** 2
    power, change = windowed([finite_pixels(variance)[..., None], light], clean)
    weight = mixing_weight(power, change)
    ratio = np.sqrt((1.0 - weight).clip(min=0.0))
    return Denoised(mixture(noisy, clean, weight), weight.astype(np.float32), ratio.astype(np.float32))


def windowed(squares: list[np.ndarray], picture: np.ndarray) -> list[np.ndarray]:
    """Windowed means `[H, W]` of squares `[H, W, C]` of radiance, relative to the squared brightness of `picture`."""
    from scipy.ndimage import gaussian_filter  # takes long to import, and most renders do not denoise

    level = gaussian_filter((picture @ LUMINANCE).clip(min=0.0), LEVEL_WINDOW, mode="nearest") + FLOOR
    return [gaussian_filter(square.mean(-1) / level**2, WINDOW, mode="nearest") for square in squares]


def mixing_weight(gain: np.ndarray, change: np.ndarray) -> np.ndarray:
    """G / Q within 0 and 1; 1 where the denoiser changes nothing."""
    return np.where(change > LEAST, (gain / change.clip(min=LEAST)).clip(0.0, 1.0), 1.0)


def mixture(noisy: np.ndarray, clean: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """N + w (D - N), float32."""
    return (noisy + weight[..., None] * (clean - noisy)).astype(np.float32)


def finite_pixels(image: np.ndarray) -> np.ndarray:
    """The image in double precision, with 0 for NaN and infinities."""
    return np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
