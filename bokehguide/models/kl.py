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
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import worthwhile


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
    counts = (contribution > 0.0) & (ratio > 0.0).index_select(0, guide.owner)
    chosen = worthwhile(counts)
    pixel, contribution, counts = (values.index_select(0, chosen) for values in (guide.owner, contribution, counts))
    strongest = torch.zeros_like(ratio).scatter_reduce_(0, pixel, contribution, "amax")
    learns = counts & (contribution == strongest.index_select(0, pixel))
    index = worthwhile(learns)
    chosen, pixel, contribution, learns = (values.index_select(0, index) for values in (chosen, pixel, contribution, learns))
    gaussian = gaussian.index_select(0, chosen)
    points, focus, mean = (values.index_select(1, of) for values, of in ((at.points, pixel), (guide.focus, pixel), (guide.mean, chosen)))
    weight, beta, density = (values.index_select(0, pixel) for values in (ratio, guide.beta, at.density))
    scale = -weight * beta * contribution / density
    basis = offsets.basis(gaussian, raster.index_select(1, pixel))
    slopes = _slopes(points, focus, mean, guide.sigma.index_select(0, chosen), scale, basis)
    slopes = torch.where(learns, slopes, 0.0)
    gradient = torch.zeros_like(offsets.coefficients, dtype=torch.float64)
    return gradient.index_add_(2, gaussian, slopes.view(*gradient.shape[:2], len(index)))


@kernel
def _slopes(points: Tensor, focus: Tensor, mean: Tensor, sigma: Tensor, scale: Tensor, basis: Tensor) -> Tensor:
    """What samples add to the gradient, float64 `[18, K]`: `scale` times ∂ log p / ∂μ, each by all rows of the basis `[6, K]`."""
    of_mean = scale * log_density_gradient(points, focus, mean, sigma)
    return torch.stack([(slope * row).double() for slope in of_mean for row in basis])
