"""The one-sample KL divergence and its gradients in closed form (Eq. 25).

The loss of a batch is -Σ ratio · log(A q). The factor ratio = L / (A q) is a constant of the differentiation. It contains the
importance weight that Eq. 25 omits (Müller et al. 2019). Guides give L in units of the frame's mean
luminance. A lens point outside the aperture has the ratio 0 and the gradient 0. Tests compare these formulas with automatic
differentiation of the same loss.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.models.base import LensDensity, LensMixture
from bokehguide.models.blend_weight import BlendWeightMap
from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.models.projection import log_density_gradient
from bokehguide.runtime.indexing import ActiveEntries


def one_sample_kl(ratio: Tensor, density: Tensor, area: float) -> Tensor:
    """The loss, a scalar: -Σ ratio · log(A q) over samples `[N]` of density q."""
    return -(ratio * (area * density).log()).nan_to_num(0.0, 0.0, 0.0).sum()


def blend_gradient(guide: LensMixture, ratio: Tensor, at: LensDensity) -> Tensor:
    """∂ loss / ∂ logit of β, `[N]`; 0 for pixels that are not guided.

    ratio: `[N]`; at: densities at the samples. If rounding moves a sample outside the rim, q and the ratio are 0.
    """
    slope = BlendWeightMap.slope(guide.beta) * guide.guided
    uniform = guide.lens.transmission(at.points) * (1.0 / guide.lens.area)
    return -ratio * (at.mixture - uniform) / at.density.clamp(min=1e-37) * slope


def offset_gradient(
    guide: GaussianMixture,
    offsets: PolynomialOffset,
    gaussian: Tensor,
    raster: Tensor,
    ratio: Tensor,
    at: LensDensity,
) -> Tensor:
    """∂ loss / ∂ coefficients, float64 `[3, 6, G]`. Only the candidate with the largest w p at each sample has a gradient.

    gaussian: Gaussian of each candidate, `[M]`; raster: raster positions, `[2, N]`; ratio: `[N]`; at: densities at the samples.
    """
    contribution = guide.weight * at.components
    counts = ActiveEntries((contribution > 0.0) & (ratio > 0.0).index_select(0, guide.owner))
    pixel, contribution = counts.select(guide.owner), counts.select(contribution)
    strongest = torch.zeros_like(ratio).scatter_reduce_(0, pixel, contribution, "amax")
    learns = ActiveEntries(counts.masked(contribution == strongest.index_select(0, pixel), False))
    chosen, pixel, contribution = (learns.select(values) for values in (counts.index, pixel, contribution))
    gaussian = gaussian.index_select(0, chosen)
    points, focus, mean = (
        values.index_select(1, of) for values, of in ((at.points, pixel), (guide.focus, pixel), (guide.mean, chosen))
    )
    weight, beta, density = (values.index_select(0, pixel) for values in (ratio, guide.beta, at.density))
    scale = -weight * beta * contribution / density
    basis = offsets.basis(gaussian, raster.index_select(1, pixel))
    slopes = _slopes(points, focus, mean, guide.sigma.index_select(0, chosen), scale, basis)
    slopes = learns.masked(slopes, 0.0)
    gradient = torch.zeros_like(offsets.coefficients, dtype=torch.float64)
    return gradient.index_add_(2, gaussian, slopes.view(*gradient.shape[:2], len(learns)))


def _slopes(points: Tensor, focus: Tensor, mean: Tensor, sigma: Tensor, scale: Tensor, basis: Tensor) -> Tensor:
    """Terms of the gradient, float64 `[18, K]`: each component of scale · ∂ log p / ∂μ times each row of the basis `[6, K]`."""
    of_mean = scale * log_density_gradient(points, focus, mean, sigma)
    return torch.stack([(slope * row).double() for slope in of_mean for row in basis])
