"""Multiple importance sampling."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from bokehguide.render.vector import divisor

BROAD = 16.0
"""Density of light samples over that of BSDF samples at which half of the light is broad (`broad_share`)."""


def power_heuristic(pdf: Tensor, other: Tensor) -> Tensor:
    """MIS weights `[N]` of samples with densities `pdf` `[N]`, if another technique has densities `other` `[N]` (Veach 1997)."""
    return 1.0 / (1.0 + (other / divisor(pdf)).square())


def light_contribution(radiance: Tensor, pdf: Tensor, value: Tensor, bsdf_pdf: Tensor) -> Tensor:
    """Reflected radiance `[3, N]` of light samples, divided by the density and multiplied by the MIS weight.

    radiance `[3, N]`, pdf `[N]`: of the light samples; value: BSDF times cosine, `[3, N]`; bsdf_pdf: density with which BSDF
    samples find the directions, `[N]`.
    """
    return value * radiance * (power_heuristic(pdf, bsdf_pdf) / divisor(pdf))


def broad_share(pdf: Tensor, bsdf_pdf: Tensor) -> Tensor:
    """Share `[N]` of the light that counts as broad: 1 where BSDF samples with the density `bsdf_pdf` find the light as often as
    light samples with the density `pdf`, and 0 where they rarely find the light."""
    return 1.0 / (1.0 + (pdf / (BROAD * divisor(bsdf_pdf))).square())


class BsdfWeights(NamedTuple):
    """MIS weights of BSDF samples.

    weight: `[N]`. broad: part of the weight of light samples that a learned factor scales, `[N]`, None without a factor.
    """

    weight: Tensor
    broad: Tensor | None = None

    @classmethod
    def with_factor(cls, pdf: Tensor, light_pdf: Tensor, factor: Tensor | float) -> BsdfWeights:
        """Weights where light samples have the power heuristic's weight less (1 - `factor`) times its broad part.

        pdf, light_pdf: densities of BSDF samples and of light samples at the samples, `[N]`. factor: `[N]`, or of all samples.
        """
        broad = power_heuristic(light_pdf, pdf) * broad_share(light_pdf, pdf)
        return cls(power_heuristic(pdf, light_pdf) + (1.0 - factor) * broad, broad)
