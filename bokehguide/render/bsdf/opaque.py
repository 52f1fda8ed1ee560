"""Opaque surfaces: glTF 2.0's metallic-roughness BRDF (appendix B), evaluated and sampled.

The code supports KHR_materials_specular (f0 and f90 of the dielectric coat, f0 in colour), KHR_materials_ior and
KHR_materials_clearcoat. The reflectance of metals follows Schlick's approximation from the base colour to white, as in glTF.

Directions are unit vectors `[3, N]` in the local shading frame, with z along the normal. `outgoing` points to the viewer, and
`incoming` points to the light. Densities are per unit solid angle of `incoming`. The microfacet part is GGX with
height-correlated Smith masking. Samples follow the visible normals (Dupuy and Benyoub 2023, spherical caps).

In glTF, the weight of the base under the coat is 1 - F(outgoing · half). At grazing angles, base and coat together then reflect
up to 1.24 of the light. Here, the weight is the product of 1 - T for the incoming direction and 1 - T for the outgoing direction
(Ashikhmin and Shirley 2000). T is an upper bound of the coat's albedo. At normal incidence, both weights are equal. At no angle
does the surface reflect more light than arrives. For a coloured f0, T belongs to the largest channel.

A clearcoat covers base and coat. The weight of the layers beneath is min(1 - T(outgoing), 1 - T(incoming)), with the T of the
clearcoat. The weight is reciprocal and conserves energy. Over a mirror, it equals the weight of glTF. Cosines and horizon refer
to the clearcoat's normal.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.render.geometry import Surface
from bokehguide.render.materials import CLEARCOAT_F0
from bokehguide.render.vector import dot, fifth_power, luminance, normalize, tangent_frame, to_local, to_world

MIN_COSINE = 1e-6
"""Least cosine to the normal in BSDFs, so that terms of grazing directions stay finite."""


def ggx_density(half: Tensor, alpha: Tensor) -> Tensor:
    """GGX normal distribution D at half vectors `[3, N]` for roughness α `[N]`.

    The code uses the tangent components, because 1 - z² would lose digits.
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
    # Half vectors stay above the surface, even if rounding makes their height 0.
    return normalize(torch.stack((hx * alpha, hy * alpha, hz.clamp(min=1e-12))))


def coat_spread(alpha: Tensor) -> Tensor:
    """Share `[N]` of Schlick's increase towards grazing angles in the albedo of a coat of roughness α `[N]`.

    The share is an upper bound, fitted to numerical integrals of the microfacet coat for all f0 below 0.4.
    """
    return 0.06 + 0.934 / (1.0 + alpha * alpha * alpha * (1.0 / 0.27**3))


TRACE = 0.006
"""Residual of `coat_spread` at steep angles, where rough coats reflect more than Schlick's f0."""


def smith_root(cosine: Tensor, a2: Tensor) -> Tensor:
    """sqrt(α² + (1 - α²) cos²), the root in Smith's masking terms."""
    return (a2 + (1.0 - a2) * cosine * cosine).sqrt()


class _Microfacets:
    """GGX microfacets of roughness α `[N]`, seen from a direction with the cosine `cosine` `[N]` to the normal."""

    def __init__(self, cosine: Tensor, alpha: Tensor):
        self._cosine, self.alpha = cosine, alpha
        self._root = smith_root(cosine, alpha * alpha)

    def evaluate(self, half: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
        """G₂ D / (4 cos cos) and the density G₁ D / (4 cos), `[N]`, for incoming cosines `[N]` and half vectors `[3, N]`."""
        distribution = 0.5 * ggx_density(half, self.alpha)
        root = smith_root(cosine, self.alpha * self.alpha)
        visibility = distribution / (cosine * self._root + self._cosine * root)
        return visibility, distribution / (self._cosine + self._root)


class _Clearcoat:
    """The layer of KHR_materials_clearcoat.

    normal: local `[3, N]`, None for the normal of the layers beneath. `outgoing` is in the frame of the clearcoat's normal.
    """

    def __init__(self, outgoing: Tensor, surface: Surface, normal: Tensor | None):
        assert surface.clearcoat is not None and surface.clearcoat_alpha is not None
        self._frame = None if normal is None else (*tangent_frame(normal), normal)
        self.outgoing = self._to_own(outgoing)
        cosine = self.outgoing[2].clamp(min=MIN_COSINE)
        self._weight = surface.clearcoat
        self.facets = _Microfacets(cosine, surface.clearcoat_alpha)
        self._minimum = self._weight * (CLEARCOAT_F0 + TRACE * (1.0 - CLEARCOAT_F0))
        self._spread = self._weight * coat_spread(surface.clearcoat_alpha) * (1.0 - CLEARCOAT_F0)
        self._leaving = self._passing(cosine)
        self.reflectance = self._weight * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * fifth_power(1.0 - cosine))
        """Approximate albedo, from which the probability of sampling the clearcoat follows."""

    def _to_own(self, direction: Tensor) -> Tensor:
        return direction if self._frame is None else to_local(direction, *self._frame)

    def from_own(self, direction: Tensor) -> Tensor:
        """Directions `[3, N]` converted from the frame of the clearcoat's normal to the frame of the surface."""
        return direction if self._frame is None else to_world(direction, *self._frame)

    def _passing(self, cosine: Tensor) -> Tensor:
        """Transmittance 1 - T of the clearcoat for directions with the cosine `cosine` `[N]` to the normal."""
        return 1.0 - self._minimum - self._spread * fifth_power(1.0 - cosine)

    def evaluate(self, incoming: Tensor, half: Tensor, grazing: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """BRDF times cosine, density, weight of the layers beneath, and 1 above the clearcoat's horizon, else 0; `[N]` each.

        grazing: (1 - outgoing · half)⁵.
        """
        incoming, half = self._to_own(incoming), self._to_own(half)
        above = (incoming[2] > 0.0).to(torch.float32)
        cosine = incoming[2].clamp(min=MIN_COSINE)
        visibility, pdf = self.facets.evaluate(half, cosine)
        value = self._weight * visibility * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * grazing)
        beneath = torch.minimum(self._leaving, self._passing(cosine))
        return value * (cosine * above), pdf * (half[2] > 0.0).to(torch.float32), beneath, above


class OpaqueBSDF:
    """Mixture of a metal and a Lambertian base under a dielectric coat. An optional clearcoat covers both.

    outgoing: local `[3, N]`, above the surface. surface: parameters. clearcoat_normal: local `[3, N]`, None for the normal of the
    layers beneath.
    """

    def __init__(self, outgoing: Tensor, surface: Surface, clearcoat_normal: Tensor | None = None):
        self._outgoing = outgoing
        self.surface = surface
        self._cosine = outgoing[2].clamp(min=MIN_COSINE)
        ratio = ((surface.ior - 1.0) / (surface.ior + 1.0)).square()
        self._f0 = peak = surface.specular * ratio
        if surface.specular_color is not None:
            self._f0 = surface.specular * (ratio * surface.specular_color).clamp(max=1.0)  # [3, N]
            peak = self._f0.amax(0)
        self._f90 = surface.specular
        self._facets = _Microfacets(self._cosine, surface.alpha)
        self._clearcoat = None if surface.clearcoat is None else _Clearcoat(outgoing, surface, clearcoat_normal)
        self._choose_shares(peak)
        rise = self._f90 - peak
        self._minimum, self._spread = peak + TRACE * rise, coat_spread(surface.alpha) * rise
        # Normalisation: mean transmittance of the coat under uniform illumination.
        entering = (1.0 - self._minimum - self._spread * (1.0 / 21.0)).clamp(min=1e-4)
        self._leaving = (1.0 - surface.metallic) * self._passing(self._cosine) / (math.pi * entering)

    def _passing(self, cosine: Tensor) -> Tensor:
        """Transmittance 1 - T of the coat for directions with the cosine `cosine` `[N]` to the normal."""
        return (1.0 - self._minimum - self._spread * fifth_power(1.0 - cosine)).clamp(min=0.0)

    def _choose_shares(self, peak: Tensor) -> None:
        """Set the probabilities of sampling the clearcoat and, beneath it, the microfacets: their approximate shares of the
        albedo.

        The albedo of the base is the albedo at normal incidence. At grazing angles, light of the base passes microfacets that
        face the viewer.
        peak: largest channel of f0, `[N]`.
        """
        surface = self.surface
        grazing = fifth_power(1.0 - self._cosine)
        base, metal = luminance(surface.base_color), surface.metallic
        coat = peak + (self._f90 - peak) * grazing
        specular = metal * (base + (1.0 - base) * grazing) + (1.0 - metal) * coat
        diffuse = (1.0 - metal) * (1.0 - peak) * base
        self._specular_share = (specular + 1e-9) / (specular + diffuse + 1e-9)
        if self._clearcoat is not None:
            over = self._clearcoat.reflectance
            self._clearcoat_share = over / (over + (1.0 - over) * (specular + diffuse) + 1e-9)

    def evaluate(self, incoming: Tensor) -> tuple[Tensor, Tensor]:
        """BRDF times cosine `[3, N]` and the density `[N]` of `sample`; 0 below the surface."""
        surface = self.surface
        above = (incoming[2] > 0.0).to(torch.float32)
        cosine = incoming[2].clamp(min=MIN_COSINE)
        half = normalize(self._outgoing + incoming)
        grazing = fifth_power(1.0 - dot(self._outgoing, half).clamp(0.0, 1.0))
        visibility, microfacet = self._facets.evaluate(half, cosine)
        metal = surface.metallic
        coat = self._f0 + (self._f90 - self._f0) * grazing
        scaled = self._leaving * self._passing(cosine) + metal * visibility * (1.0 - grazing)
        white = visibility * ((1.0 - metal) * coat + metal * grazing)
        value = surface.base_color * scaled + white
        share = self._specular_share
        pdf = share * microfacet + (1.0 - share) * cosine * (1.0 / math.pi)
        value = value * (cosine * above)
        if self._clearcoat is not None:
            over, microfacet, beneath, above_coat = self._clearcoat.evaluate(incoming, half, grazing)
            value = value * beneath + over
            # Between the horizons of both normals, the density of a lobe includes directions below the lobe's own horizon.
            pdf = pdf * (half[2] > 0.0).to(torch.float32)
            pdf = pdf + (microfacet - pdf) * self._clearcoat_share
            above = torch.maximum(above, above_coat)
        return value, pdf * above

    def sample(self, uniforms: Tensor) -> Tensor:
        """Incoming directions `[3, N]`, possibly below the surface, from uniform numbers `[3, N]`."""
        outgoing, alpha, microfacet_share, coat = self._outgoing, self.surface.alpha, self._specular_share, self._clearcoat
        if coat is None:
            half = sample_visible_normal(outgoing, alpha, uniforms[1:])
        else:
            share = self._clearcoat_share
            over = (uniforms[0] < share).to(torch.float32)
            alpha = alpha + (coat.facets.alpha - alpha) * over
            microfacet_share = share + (1.0 - share) * microfacet_share
            outgoing = outgoing + (coat.outgoing - outgoing) * over
            half = sample_visible_normal(outgoing, alpha, uniforms[1:])
            half = half + (coat.from_own(half) - half) * over
        mirrored = 2.0 * dot(self._outgoing, half) * half - self._outgoing
        angle, radius = 2.0 * math.pi * uniforms[1], uniforms[2].sqrt()
        height = (1.0 - uniforms[2]).sqrt()
        diffuse = torch.stack((radius * angle.cos(), radius * angle.sin(), height))
        specular = (uniforms[0] < microfacet_share).to(torch.float32)
        return diffuse + (mirrored - diffuse) * specular
