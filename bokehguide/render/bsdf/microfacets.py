"""GGX microfacets, isotropic and anisotropic, and sampling by visible normals.

Directions are unit vectors `[3, N]` in the local frame, with z along the normal. Densities are per unit solid angle of the
incoming direction. The masking is height-correlated Smith masking. Samples follow the visible normals (Dupuy and Benyoub 2023,
spherical caps). Anisotropic microfacets have the roughness α `alpha` along y and `along` along x (KHR_materials_anisotropy).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.render.vector import normalize

MIN_COSINE = 1e-6
"""Least cosine to the normal in BSDFs, so that terms of grazing directions stay finite."""


def ggx_density(half: Tensor, alpha: Tensor, along: Tensor | None = None) -> Tensor:
    """GGX normal distribution D at half vectors `[3, N]` for roughness α `[N]`; along: α along x, None for α.

    The code uses the tangent components, because 1 - z² would lose digits.
    """
    x, y, z = half.unbind(0)
    if along is not None:
        t = (x / along).square() + (y / alpha).square() + z * z
        return 1.0 / (math.pi * alpha * along * t * t)
    a2 = alpha * alpha
    t = (x * x + y * y) / a2 + z * z
    return 1.0 / (math.pi * a2 * t * t)


def sample_visible_normal(outgoing: Tensor, alpha: Tensor, uniforms: Tensor, along: Tensor | None = None) -> Tensor:
    """Half vectors `[3, N]` distributed as the normals visible from `outgoing`; uniforms `[2, N]`."""
    along = alpha if along is None else along
    ox, oy, oz = outgoing.unbind(0)
    stretched = normalize(torch.stack((ox * along, oy * alpha, oz)))
    phi = 2.0 * math.pi * uniforms[0]
    z = (1.0 - uniforms[1]) * (1.0 + stretched[2]) - stretched[2]
    sine = (1.0 - z * z).clamp(min=0.0).sqrt()
    hx, hy, hz = (torch.stack((sine * phi.cos(), sine * phi.sin(), z)) + stretched).unbind(0)
    # Half vectors stay above the surface, even if rounding makes their height 0.
    return normalize(torch.stack((hx * along, hy * alpha, hz.clamp(min=1e-12))))


def smith_root(cosine: Tensor, a2: Tensor) -> Tensor:
    """sqrt(α² + (1 - α²) cos²), the root in Smith's masking terms, `[N]`. cosine, a2: cos and α², `[N]`."""
    return (a2 + (1.0 - a2) * cosine * cosine).sqrt()


class Microfacets:
    """GGX microfacets of roughness α `alpha` `[N]`, seen from directions `outgoing` `[3, N]`.

    along: α along x, `[N]`; None for α.
    """

    def __init__(self, outgoing: Tensor, alpha: Tensor, along: Tensor | None = None):
        self.alpha, self.along = alpha, along
        self._cosine = outgoing[2].clamp(min=MIN_COSINE)
        self._root = self._masking_root(outgoing, self._cosine)

    def _masking_root(self, direction: Tensor, cosine: Tensor) -> Tensor:
        if self.along is None:
            return smith_root(cosine, self.alpha * self.alpha)
        return ((self.along * direction[0]).square() + (self.alpha * direction[1]).square() + cosine * cosine).sqrt()

    def facing(self, direction: Tensor) -> Tensor:
        """α in the plane of the normal and directions `[3, N]`, `[N]` (Heitz 2014)."""
        if self.along is None:
            return self.alpha
        x, y = direction[0].square(), direction[1].square() + 1e-12
        return ((self.along.square() * x + self.alpha.square() * y) / (x + y)).sqrt()

    def evaluate(self, half: Tensor, incoming: Tensor) -> tuple[Tensor, Tensor]:
        """G₂ D / (4 cos cos) and the density G₁ D / (4 cos), `[N]`, for incoming directions and half vectors `[3, N]`."""
        cosine = incoming[2].clamp(min=MIN_COSINE)
        distribution = 0.5 * ggx_density(half, self.alpha, self.along)
        visibility = distribution / (cosine * self._root + self._cosine * self._masking_root(incoming, cosine))
        return visibility, distribution / (self._cosine + self._root)
