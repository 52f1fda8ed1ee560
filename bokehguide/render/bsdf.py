"""Opaque surfaces: glTF 2.0's metallic-roughness BRDF (appendix B), evaluated and sampled.

Directions are unit `[3, N]` in the local shading frame, z along the normal. `outgoing`
points to the viewer, `incoming` to the light. Densities are per unit solid angle of
`incoming`. The microfacet part is GGX with height-correlated Smith masking, sampled by
its visible normals (Dupuy and Benyoub 2023, spherical caps).

Under the coat glTF's base counts 1 - F(outgoing · half), which together with the coat
reflects up to 1.24 of the light at grazing angles. Here light passes the coat on its way
in and on its way out, 1 - T each (Ashikhmin and Shirley 2000), and T is never below the
coat's albedo: seen head-on the two are the same, and no angle reflects more than arrives.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.render.geometry import Surface
from bokehguide.render.vector import dot, luminance, normalize


def ggx_density(half: Tensor, alpha: Tensor) -> Tensor:
    """GGX normal distribution D at half vectors `[3, N]` for roughness α `[N]`.

    Written in the tangent components, which keeps its digits where 1 - z² loses them.
    """
    x, y, z = half.unbind(0)
    a2 = alpha * alpha
    t = (x * x + y * y) / a2 + z * z
    return 1.0 / (math.pi * a2 * t * t)


def sample_visible_normal(outgoing: Tensor, alpha: Tensor, uniforms: Tensor) -> Tensor:
    """Half vectors `[3, N]` distributed as the normals visible from `outgoing`; uniforms `[2, N]`."""
    ox, oy, oz = outgoing.unbind(0)
    stretched = normalize(torch.stack((ox * alpha, oy * alpha, oz)))
    phi = 2.0 * math.pi * uniforms[0]
    z = (1.0 - uniforms[1]) * (1.0 + stretched[2]) - stretched[2]
    sine = (1.0 - z * z).clamp(min=0.0).sqrt()
    hx, hy, hz = (torch.stack((sine * phi.cos(), sine * phi.sin(), z)) + stretched).unbind(0)
    return normalize(torch.stack((hx * alpha, hy * alpha, hz.clamp(min=1e-12))))


def coat_spread(alpha: Tensor) -> Tensor:
    """How much of Schlick's rise towards grazing angles a coat of roughness α `[N]` shows in its albedo.

    Fitted to quadratures of the microfacet coat over all f0 below 0.4, from above.
    """
    return 0.06 + 0.934 / (1.0 + alpha * alpha * alpha * (1.0 / 0.27**3))


TRACE = 0.006
"""What the fit of `coat_spread` leaves at steep angles, where rough coats reflect more than Schlick's f0."""


def smith_root(cosine: Tensor, a2: Tensor) -> Tensor:
    """sqrt(α² + (1 - α²) cos²), the root in Smith's masking terms."""
    return (a2 + (1.0 - a2) * cosine * cosine).sqrt()


class OpaqueBSDF:
    """Mixture of a Lambertian base under a dielectric coat, and a metal.

    outgoing: local `[3, N]` above the surface; surface: the parameters.
    """

    def __init__(self, outgoing: Tensor, surface: Surface):
        self._outgoing = outgoing
        self._surface = surface
        self._cosine = outgoing[2].clamp(min=1e-6)
        self._f0 = surface.specular * ((surface.ior - 1.0) / (surface.ior + 1.0)).square()
        self._f90 = surface.specular
        self._root = smith_root(self._cosine, surface.alpha * surface.alpha)
        self._specular_share = self._choose_share()
        rise = self._f90 - self._f0
        self._held, self._spread = self._f0 + TRACE * rise, coat_spread(surface.alpha) * rise
        # What enters uniformly from all sides, 1 - T over the cosine, leaves the coat again.
        entering = 1.0 - self._held - self._spread * (1.0 / 21.0)
        self._leaving = (1.0 - surface.metallic) * self._passing(self._cosine) / (math.pi * entering)

    def _passing(self, cosine: Tensor) -> Tensor:
        """1 - T: the share of light under `cosine` `[N]` that passes the coat."""
        weight = 1.0 - cosine
        return 1.0 - self._held - self._spread * (weight.square().square() * weight)

    def _choose_share(self) -> Tensor:
        """Probability of sampling the microfacet lobe: about its share of the reflectance.

        The base counts as if seen head-on: at grazing angles its light still comes through
        microfacets that face the viewer.
        """
        surface = self._surface
        grazing = (1.0 - self._cosine).square().square() * (1.0 - self._cosine)
        base, metal = luminance(surface.base_color), surface.metallic
        coat = self._f0 + (self._f90 - self._f0) * grazing
        specular = metal * (base + (1.0 - base) * grazing) + (1.0 - metal) * coat
        diffuse = (1.0 - metal) * (1.0 - self._f0) * base
        return (specular + 1e-9) / (specular + diffuse + 1e-9)

    def evaluate(self, incoming: Tensor) -> tuple[Tensor, Tensor]:
        """BRDF times cosine `[3, N]` and the density `[N]` of `sample`; 0 below the surface."""
        surface = self._surface
        above = (incoming[2] > 0.0).to(torch.float32)
        cosine = incoming[2].clamp(min=1e-6)
        half = normalize(self._outgoing + incoming)
        distribution = ggx_density(half, surface.alpha)
        weight = 1.0 - dot(self._outgoing, half).clamp(0.0, 1.0)
        grazing = weight.square().square() * weight
        root = smith_root(cosine, surface.alpha * surface.alpha)
        visibility = 0.5 * distribution / (cosine * self._root + self._cosine * root)
        metal = surface.metallic
        coat = self._f0 + (self._f90 - self._f0) * grazing
        scaled = self._leaving * self._passing(cosine) + metal * visibility * (1.0 - grazing)
        white = visibility * ((1.0 - metal) * coat + metal * grazing)
        value = (surface.base_color * scaled + white) * (cosine * above)
        microfacet = 0.5 * distribution / (self._cosine + self._root)
        share = self._specular_share
        return value, (share * microfacet + (1.0 - share) * cosine * (1.0 / math.pi)) * above

    def sample(self, uniforms: Tensor) -> Tensor:
        """Incoming directions `[3, N]`, possibly below the surface, from uniform numbers `[3, N]`."""
        half = sample_visible_normal(self._outgoing, self._surface.alpha, uniforms[1:])
        mirrored = 2.0 * dot(self._outgoing, half) * half - self._outgoing
        radius, angle = uniforms[1].sqrt(), 2.0 * math.pi * uniforms[2]
        height = (1.0 - uniforms[1]).sqrt()
        diffuse = torch.stack((radius * angle.cos(), radius * angle.sin(), height))
        specular = (uniforms[0] < self._specular_share).to(torch.float32)
        return diffuse + (mirrored - diffuse) * specular
