"""The one-sample KL divergence and its gradients in closed form (Eq. 25).

The loss of a batch is -Σ ratio · log(A q), with ratio = L / (A q) held constant: the
importance weight that Eq. 25 leaves out is in it (Müller et al. 2019). A draw outside the
aperture has ratio 0 and thus no gradient. Automatic differentiation of the same loss is
the reference that these formulas are tested against.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.models.blend_weight import BlendWeightMap
from bokehguide.models.lens_distribution import GuidedLensDistribution, LensDensity
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.models.projection import log_density_gradient
from bokehguide.render.pixels import indices


def one_sample_kl(ratio: Tensor, density: Tensor, area: float) -> Tensor:
    """The loss, a scalar: -Σ ratio · log(A q) over samples `[N]` of density q."""
    return -(ratio * (area * density).log()).nan_to_num(0.0, 0.0, 0.0).sum()


def blend_gradient(guide: GuidedLensDistribution, ratio: Tensor, at: LensDensity) -> Tensor:
    """∂ loss / ∂ logit of β, `[N]`, at samples drawn `at` some points; 0 where there is nothing to blend.

    A rim draw that rounding puts outside has q = 0, and ratio 0.
    """
    slope = BlendWeightMap.slope(guide.beta) * guide.guided
    uniform = guide.lens.transmission(at.points) * (1.0 / guide.lens.area)
    return -ratio * (at.mixture - uniform) / at.density.clamp(min=1e-37) * slope


def offset_gradient(
    guide: GuidedLensDistribution,
    offsets: PolynomialOffset,
    gaussian: Tensor,
    raster: Tensor,
    ratio: Tensor,
    at: LensDensity,
) -> Tensor:
    """∂ loss / ∂ coefficients, float64 `[3, 6, G]`, through the candidate with the largest w p at each point.

    gaussian: Gaussian of each candidate `[M]`; raster: `[2, N]`; ratio: `[N]`.
    """
    contribution = guide.weight * at.components
    strongest = torch.zeros_like(ratio).scatter_reduce(0, guide.owner, contribution, "amax")
    learns = (contribution > 0.0) & (contribution == strongest[guide.owner]) & (ratio[guide.owner] > 0.0)
    chosen = indices(learns)
    pixel = guide.owner[chosen]
    mean_gradient = log_density_gradient(
        at.points[:, pixel], guide.focus[:, pixel], guide.mean[:, chosen], guide.sigma[chosen]
    )
    scale = -ratio[pixel] * guide.beta[pixel] * contribution[chosen] / at.density[pixel]
    basis = offsets.basis(gaussian[chosen], raster[:, pixel])
    outer = (mean_gradient * scale)[:, None] * basis[None]  # [3, 6, K]
    gradient = torch.zeros_like(offsets.coefficients, dtype=torch.float64)
    return gradient.index_add_(2, gaussian[chosen], outer.double())
