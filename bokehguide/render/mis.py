"""Multiple importance sampling."""

from __future__ import annotations

from torch import Tensor

from bokehguide.render.vector import divisor


def power_heuristic(pdf: Tensor, other: Tensor) -> Tensor:
    """MIS weight of a sample with the density `pdf`, if another technique has the density `other` (Veach 1997)."""
    return 1.0 / (1.0 + (other / divisor(pdf)).square())


def bsdf_weight(pdf: Tensor, other: Tensor, count: int) -> Tensor:
    """MIS weight of each of `count` BSDF samples with the density `pdf`, if light samples together have the density `other`."""
    return power_heuristic(count * pdf, other) / count


def light_contribution(radiance: Tensor, pdf: Tensor, value: Tensor, bsdf_pdf: Tensor, count: int = 1) -> Tensor:
    """Reflected radiance `[3, N]` of light samples, divided by the density and multiplied by the MIS weight.

    radiance `[3, N]`, pdf `[N]`: of the light samples; value: BSDF times cosine, `[3, N]`; bsdf_pdf: density with which BSDF
    samples together find the directions, `[N]`. count: see `LightDistribution`.
    """
    return value * radiance * (power_heuristic(count * pdf, bsdf_pdf) / divisor(pdf))
