"""Statistical checks: each returns a p-value, so that a test can also assert that it fails.

Policy. Every seed is fixed, so a result changes only with the code, or with a library that
rounds differently. A check covers all of its cells, pixels or parameters at once (Šidák)
and fails below SIGNIFICANCE = 1e-4. The suite makes about 200 such checks: with independent
random numbers it would fail by chance once in 50 runs.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

SIGNIFICANCE = 1e-4
FEWEST_EXPECTED = 5.0
"""Cells of a histogram that expect fewer draws are pooled."""


def sidak(p_values: np.ndarray) -> float:
    """The p-value of the smallest of many independent p-values."""
    p_values = np.asarray(p_values, np.float64).ravel()
    return float(-np.expm1(len(p_values) * np.log1p(-min(p_values.min(), 1.0 - 1e-16))))


def z_test(difference: np.ndarray, standard_error: np.ndarray) -> float:
    """Whether all `difference`s are zero, given their standard errors (same shape).

    A difference without any error must vanish but for rounding; one that is not finite
    fails outright.
    """
    difference, standard_error = np.broadcast_arrays(np.asarray(difference, np.float64), np.asarray(standard_error))
    if not (np.isfinite(difference).all() and np.isfinite(standard_error).all()):
        return 0.0
    z = np.abs(difference) / np.maximum(standard_error, 1e-7)
    return sidak(2.0 * stats.norm.sf(z))


def chi_square(observed: np.ndarray, probability: np.ndarray) -> float:
    """Goodness of fit of the counts `observed` to the cells' `probability`, which sum to 1.

    Fails outright on a negative probability, on one that is not finite, and on a draw where
    nothing can be.
    """
    observed, expected = np.asarray(observed, np.float64).ravel(), np.asarray(probability, np.float64).ravel()
    expected = expected * observed.sum()
    if not np.isfinite(expected).all() or (expected < -1e-6).any() or observed[expected <= 0.0].any():
        return 0.0
    order = np.argsort(expected)
    observed, expected = observed[order], expected[order]
    pooled = np.searchsorted(expected, FEWEST_EXPECTED)
    while 0 < pooled < len(expected) and expected[:pooled].sum() < FEWEST_EXPECTED:
        pooled += 1
    if pooled > 0:
        observed = np.append(observed[pooled:], observed[:pooled].sum())
        expected = np.append(expected[pooled:], expected[:pooled].sum())
    statistic = ((observed - expected) ** 2 / np.maximum(expected, 1e-30)).sum()
    return float(stats.chi2.sf(statistic, len(expected) - 1))


def block_means(image: np.ndarray, size: int) -> np.ndarray:
    """Means over `size × size` blocks of `[H, W]`; both sides must be multiples of `size`."""
    height, width = image.shape
    return image.reshape(height // size, size, width // size, size).mean((1, 3))


def uniformity(numbers: np.ndarray, bins: int = 1024) -> float:
    """p-value of numbers in 0 … 1 being uniform."""
    counts = np.bincount((numbers.ravel() * bins).astype(int), minlength=bins)
    return chi_square(counts, np.full(bins, 1.0 / bins))


def independence(a: np.ndarray, b: np.ndarray, bins: int = 32) -> float:
    """The smaller p-value of two: pairs being uniform in the unit square, and being uncorrelated."""
    a, b = a.ravel(), b.ravel()
    cell = (a * bins).astype(int) * bins + (b * bins).astype(int)
    filled = chi_square(np.bincount(cell, minlength=bins * bins), np.full(bins * bins, bins**-2.0))
    return min(filled, z_test(np.corrcoef(a, b)[0, 1], 1.0 / np.sqrt(len(a))))
