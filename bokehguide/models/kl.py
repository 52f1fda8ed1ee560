"""The one-sample KL divergence and its gradients in closed form (Eq. 25).

The loss of a batch is -Σ ratio · log(A q), with ratio = L / (A q) held constant: the
importance weight that Eq. 25 leaves out is in it (Müller et al. 2019). A draw outside the
aperture has ratio 0 and thus no gradient. Automatic differentiation of the same loss is
the reference that these formulas are tested against.
"""

from __future__ import annotations

from torch import Tensor

import torch

from bokehguide.models.blend_weight import BlendWeightMap
from bokehguide.models.lens_distribution import GuidedLensDistribution
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.models.projection import log_density_gradient


def one_sample_kl(ratio: Tensor, density: Tensor, area: float) -> Tensor:
    """The loss, a scalar: -Σ ratio · log(A q) over samples `[N]` of density q."""
    return -(ratio * (area * density).log()).nan_to_num(0.0, 0.0, 0.0).sum()


def blend_gradient(guide: GuidedLensDistribution, ratio: Tensor, mixture: Tensor, density: Tensor) -> Tensor:
    """∂ loss / ∂ logit of β, `[N]`; 0 where there is nothing to blend, or where q and with it the ratio is 0."""
    slope = BlendWeightMap.slope(guide.beta) * guide.guided
    return -ratio * (mixture - 1.0 / guide.lens.area) / density.clamp(min=1e-20) * slope


def offset_gradient(
    guide: GuidedLensDistribution,
    offsets: PolynomialOffset,
    gaussian: Tensor,
    raster: Tensor,
    points: Tensor,
    ratio: Tensor,
    components: Tensor,
    density: Tensor,
) -> Tensor:
    """∂ loss / ∂ coefficients `[3, 6, G]`, through the candidate with the largest w p at each point.

    gaussian: Gaussian of each candidate `[M]`; raster: `[2, N]`; points: lens points `[2, N]`;
    components: p_i `[M]`; density: q `[N]`.
    """
    contribution = guide.weight * components
    strongest = torch.zeros_like(ratio).scatter_reduce(0, guide.owner, contribution, "amax")
    learns = (contribution > 0.0) & (contribution == strongest[guide.owner]) & (ratio[guide.owner] > 0.0)
    chosen = learns.nonzero()[:, 0]
    pixel = guide.owner[chosen]
    mean_gradient = log_density_gradient(
        points[:, pixel], guide.focus[:, pixel], guide.mean[:, chosen], guide.sigma[chosen]
    )
    scale = -ratio[pixel] * guide.beta[pixel] * contribution[chosen] / density[pixel]
    basis = offsets.basis(gaussian[chosen], raster[:, pixel])
    outer = (mean_gradient * scale)[:, None] * basis[None]  # [3, 6, K]
    return torch.zeros_like(offsets.coefficients).index_add_(2, gaussian[chosen], outer)
