"""Transmissive surfaces: clear or rough glass, as the boundary of a solid or as a thin sheet.

Directions are unit vectors `[3, N]` in the local shading frame, with z along the normal on the viewer's side. Light from an
incoming direction with z < 0 is transmitted. Densities are per unit solid angle. The BSDF of a smooth surface is a delta
distribution, with the density DELTA_PDF in `sample` and the density 0 in `evaluate`. Rough refraction follows Walter et al. 2007.
Transmission scales radiance by 1/η².
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.bsdf.microfacets import MIN_COSINE, ggx_density, sample_visible_normal, smith_root
from bokehguide.render.bsdf.thin_film import film_reflectance
from bokehguide.render.surface import SMOOTH_ALPHA, Surface
from bokehguide.render.vector import divisor, dot, normalize
from bokehguide.runtime.device import to_device

DELTA_PDF = 1e30
"""Density of a delta distribution. It is so large that the MIS weight is 1 in float32."""
_BELOW = (1.0, 1.0, -1.0)


def fresnel(cosine: Tensor, eta: Tensor) -> Tensor:
    """Unpolarised reflectance `[N]` at |cos θ| towards relative index η; 1 in total reflection."""
    cosine = cosine.abs().clamp(max=1.0)
    transmitted = (1.0 - (1.0 - cosine * cosine) / (eta * eta)).clamp(min=0.0).sqrt()
    parallel = (eta * cosine - transmitted) / divisor(eta * cosine + transmitted, 1e-12)
    perpendicular = (cosine - eta * transmitted) / divisor(cosine + eta * transmitted, 1e-12)
    return 0.5 * (parallel * parallel + perpendicular * perpendicular)


class DielectricBSDF:
    """Reflection and transmission at a dielectric boundary.

    Each transmission multiplies the radiance by the base colour. outgoing: local `[3, N]` with z > 0. surface: parameters.
    """

    def __init__(self, outgoing: Tensor, surface: Surface):
        self._outgoing = outgoing
        self._surface = surface
        self._cosine = outgoing[2].clamp(min=MIN_COSINE)
        self._solid = 1.0 - surface.thin
        inside = surface.front * surface.ior + (1.0 - surface.front) / surface.ior
        self._eta = inside * self._solid + surface.ior * surface.thin
        straight = ((self._eta - 1.0).abs() < 1e-4) & (surface.thin == 0.0)  # without refraction, there is no microfacet normal
        self._smooth = ((surface.alpha < SMOOTH_ALPHA) | straight).to(torch.float32)
        self._alpha = surface.alpha.clamp(min=SMOOTH_ALPHA)
        self._root = smith_root(self._cosine, self._alpha * self._alpha)

    def _reflectance(self, cosine: Tensor) -> Tensor:
        """Fresnel reflectance `[N]` of the boundary, or of both faces of a thin sheet; the mean of the channels with a film."""
        if self._surface.iridescence is not None:
            return self._colored_reflectance(cosine).mean(0)
        return self._both_faces(fresnel(cosine, self._eta))

    def _both_faces(self, single: Tensor) -> Tensor:
        return single * self._solid + 2.0 * single / (1.0 + single) * self._surface.thin

    def _colored_reflectance(self, cosine: Tensor) -> Tensor:
        """Reflectances `[3, N]` of a boundary with a film. From inside, they are those from outside at the refracted angle."""
        surface, cosine = self._surface, cosine.abs().clamp(max=1.0)
        assert surface.iridescence is not None and surface.film_ior is not None and surface.film_thickness is not None
        squared = 1.0 - (1.0 - cosine.square()) * surface.ior.square()
        leaves = (1.0 - surface.front) * self._solid
        outside = cosine + (squared.clamp(min=0.0).sqrt() - cosine) * leaves
        f0 = ((surface.ior - 1.0) / (surface.ior + 1.0)).square().expand(3, -1)
        film = film_reflectance(f0, surface.film_ior, surface.film_thickness, outside)
        plain = fresnel(cosine, self._eta)
        film = torch.where((squared < 0.0) & (leaves > 0.0), 1.0, film)
        return self._both_faces(plain + (film - plain) * surface.iridescence)

    def _half(self, incoming: Tensor, below: Tensor) -> Tensor:
        """Microfacet normals `[3, N]`, on the upper side, that reflect or refract `incoming` to `outgoing`."""
        mirrored = torch.stack((incoming[0], incoming[1], incoming[2] * (1.0 - 2.0 * below)))
        refracts = below * self._solid
        half = normalize(self._outgoing + mirrored * (1.0 - refracts) + self._eta * incoming * refracts)
        return half * torch.copysign(torch.ones_like(below), half[2])

    def evaluate(self, incoming: Tensor) -> tuple[Tensor, Tensor]:
        """BSDF times |cosine| `[3, N]` and the density `[N]` of `sample`; both are 0 for smooth surfaces."""
        below = (incoming[2] < 0.0).to(torch.float32)
        half = self._half(incoming, below)
        toward_viewer, toward_light = dot(self._outgoing, half), dot(incoming, half)
        refracts = below * self._solid
        # Microfacets seen from behind, or refracting to the wrong side, contribute nothing.
        valid = (toward_viewer > 0.0).to(torch.float32) * (1.0 - self._smooth)
        valid = valid * (1.0 - refracts * (toward_light > 0.0).to(torch.float32))
        cosine = incoming[2].abs().clamp(min=MIN_COSINE)
        visible = ggx_density(half, self._alpha) * 2.0 / (self._cosine + self._root)
        bend = divisor((toward_viewer + self._eta * toward_light).square(), 1e-20)
        jacobian = refracts * self._eta.square() * toward_light.abs() * toward_viewer / bend + 0.25 * (1.0 - refracts)
        reflectance = self._reflectance(toward_viewer)
        share = reflectance + below * (1.0 - 2.0 * reflectance)
        pdf = torch.where(valid > 0.0, share * visible * jacobian, 0.0)
        return self._tint(below, toward_viewer) * (pdf * self._masking(cosine)), pdf

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Incoming directions `[3, N]`, weights BSDF·|cos|/pdf `[3, N]` and densities `[N]`, from uniforms `[3, N]`."""
        rough = sample_visible_normal(self._outgoing, self._alpha, uniforms[1:])
        upright = torch.zeros_like(rough)
        upright[2] = 1.0
        half = rough + (upright - rough) * self._smooth
        cosine = dot(self._outgoing, half)
        reflectance = self._reflectance(cosine)
        below = (uniforms[0] >= reflectance).to(torch.float32)
        mirrored = 2.0 * cosine * half - self._outgoing
        flipped = mirrored * to_device(_BELOW, half.device)[:, None]
        incoming = mirrored + (flipped - mirrored) * (below * self._surface.thin)
        incoming = incoming + (self._refract(half, cosine) - incoming) * (below * self._solid)
        right_side = ((incoming[2] < 0.0) == (below > 0.0)).to(torch.float32)
        _, pdf = self.evaluate(incoming)
        pdf = pdf + self._smooth * DELTA_PDF
        masking = self._masking(incoming[2].abs().clamp(min=MIN_COSINE))
        masking = masking + (1.0 - masking) * self._smooth
        return incoming, self._tint(below, cosine) * (masking * right_side), pdf

    def _refract(self, half: Tensor, cosine: Tensor) -> Tensor:
        transmitted = (1.0 - (1.0 - cosine * cosine) / self._eta.square()).clamp(min=0.0).sqrt()
        return (cosine / self._eta - transmitted) * half - self._outgoing / self._eta

    def _tint(self, below: Tensor, cosine: Tensor) -> Tensor:
        """Value over the density's reflectance or transmittance `[3, N]`; cosine: between viewer and half vector, `[N]`."""
        scale = below * self._solid / self._eta.square() + below * self._surface.thin
        tint = self._surface.base_color * scale + (1.0 - below)
        if self._surface.iridescence is None:
            return tint
        colored = self._colored_reflectance(cosine)
        mean = colored.mean(0)
        reflected, transmitted = colored / divisor(mean, 1e-6), (1.0 - colored) / divisor(1.0 - mean, 1e-6)
        return tint * (reflected + (transmitted - reflected) * below)

    def _masking(self, cosine: Tensor) -> Tensor:
        """G2 / G1(outgoing), height-correlated Smith."""
        root = smith_root(cosine, self._alpha * self._alpha)
        return (self._cosine + self._root) / (self._cosine * root / cosine + self._root)
