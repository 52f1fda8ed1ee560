"""Opaque surfaces: glTF 2.0's metallic-roughness BRDF (appendix B), evaluated and sampled.

The code supports KHR_materials_specular (f0 and f90 of the dielectric coat, f0 in colour), KHR_materials_ior and
KHR_materials_clearcoat. The reflectance of metals follows Schlick's approximation from the base colour to white, as in glTF.
The energy of metals includes multiple scattering between microfacets (`multiscatter.py`).

Directions are unit vectors `[3, N]` in the local shading frame, with z along the normal. `outgoing` points to the viewer, and
`incoming` points to the light. Densities are per unit solid angle of `incoming`. The microfacet part is GGX with
height-correlated Smith masking, anisotropic by KHR_materials_anisotropy.

In glTF, the weight of the base under the coat is 1 - F(outgoing · half). At grazing angles, base and coat together then reflect
up to 1.24 of the light. Here, the weight is (1 - T(incoming)) (1 - T(outgoing)) / (1 - mean of T), with the albedo T of the coat
(`coat_albedo.py`). A white base under a coat then reflects all light at every angle. The weight is reciprocal and conserves
energy. For a coloured f0, T belongs to the largest channel.

A clearcoat covers base and coat. The weight of the layers beneath is min(1 - T(outgoing), 1 - T(incoming)), with the albedo T of
the clearcoat. The weight is reciprocal and conserves energy. Over a mirror, it equals the weight of glTF. Cosines and horizon
refer to the clearcoat's normal.

A thin film (KHR_materials_iridescence) changes the reflectances of coat and metal. T is then the reflectance of both faces of the
film in phase, which is an upper bound.

A sheen (KHR_materials_sheen) lies between clearcoat and coat. Diffuse transmission (KHR_materials_diffuse_transmission) replaces
a share of the Lambertian base by a Lambertian lobe below the surface. All layers weigh the light from below like the light from
above, by the absolute cosine.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.render.bsdf.clearcoat import Clearcoat
from bokehguide.render.bsdf.coat_albedo import CoatAlbedo
from bokehguide.render.bsdf.microfacets import MIN_COSINE, Microfacets, sample_visible_normal
from bokehguide.render.bsdf.multiscatter import metal_gain
from bokehguide.render.bsdf.sheen import Sheen, sample_hemisphere
from bokehguide.render.bsdf.thin_film import film_bound, film_reflectance
from bokehguide.render.surface import Surface
from bokehguide.render.vector import dot, fifth_power, luminance, normalize

LEAST_ENTERING = 0.2
"""Least share of light below a coat as a divisor: errors of the table stay small under coats that reflect almost all."""
FILM_TRACE = 0.006
"""Margin of the bound under a film at steep angles, where rough coats reflect more than smooth coats."""


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
        self._facets = Microfacets(outgoing, surface.alpha, surface.alpha_along)
        self._clearcoat = None if surface.clearcoat is None else Clearcoat(outgoing, surface, clearcoat_normal)
        self._sheen = None if surface.sheen_color is None else Sheen(self._cosine, surface)
        self._choose_shares(peak)
        self._albedo = CoatAlbedo(self._facets, peak, self._f90 - peak)
        # Normalisation: mean transmittance of the coat under uniform illumination.
        entering = (1.0 - self._albedo.mean()).clamp(min=LEAST_ENTERING)
        if surface.iridescence is not None:
            steepest = self._passing_film(torch.ones_like(self._cosine)) * (20.0 / 21.0)
            entering = (entering + (steepest - entering) * surface.iridescence).clamp(min=1e-4)
        self._leaving = (1.0 - surface.metallic) * self._passing(self._outgoing, self._cosine) / (math.pi * entering)
        perfect = CoatAlbedo(self._facets, torch.ones_like(peak), torch.zeros_like(peak))
        self._metal = surface.metallic * metal_gain(surface, perfect, outgoing, self._cosine)  # [3, N]

    def _film(self) -> tuple[Tensor, Tensor, Tensor]:
        """Share, index of refraction and thickness `[N]` of the film."""
        share, ior, thickness = self.surface.iridescence, self.surface.film_ior, self.surface.film_thickness
        assert share is not None and ior is not None and thickness is not None
        return share, ior, thickness

    def _fresnel(self, cosine: Tensor, grazing: Tensor) -> tuple[Tensor, Tensor]:
        """Reflectances of coat and metal `[3, N]` with a film, at cosines `[N]` to the half vector; grazing: (1 - cosine)⁵."""
        share, ior, thickness = self._film()
        base = self.surface.base_color
        coat, metal = self._f0 + (self.surface.specular - self._f0) * grazing, base + (1.0 - base) * grazing
        coat = coat + (film_reflectance(self._f0.expand(3, -1), ior, thickness, cosine) - coat) * share
        return coat, metal + (film_reflectance(base, ior, thickness, cosine) - metal) * share

    def _passing(self, direction: Tensor, cosine: Tensor) -> Tensor:
        """Transmittance 1 - T of the coat for directions `[3, N]` with the cosine `cosine` `[N]` to the normal."""
        passing = (1.0 - self._albedo.towards(direction, cosine)).clamp(min=0.0)
        if self.surface.iridescence is None:
            return passing
        return passing + (self._passing_film(cosine) - passing) * self.surface.iridescence

    def _passing_film(self, cosine: Tensor) -> Tensor:
        """Transmittance 1 - T of a coat that the film covers, for cosines `[N]` to the normal."""
        _, ior, thickness = self._film()
        return (1.0 - FILM_TRACE) * (1.0 - film_bound(self._f0.expand(3, -1), ior, thickness, cosine))

    def _choose_shares(self, peak: Tensor) -> None:
        """Set the probabilities of sampling the clearcoat, the microfacets beneath it, the sheen, and the lobe below the surface.

        Each probability is the lobe's approximate share of the albedo that the earlier lobes leave.
        The albedo of the base is the albedo at normal incidence. At grazing angles, light of the base passes microfacets that
        face the viewer.
        peak: largest channel of f0, `[N]`.
        """
        surface = self.surface
        grazing = fifth_power(1.0 - self._cosine)
        base, metal = luminance(surface.base_color), surface.metallic
        coat = peak + (self._f90 - peak) * grazing
        specular = metal * (base + (1.0 - base) * grazing) + (1.0 - metal) * coat
        if surface.iridescence is not None:
            coat, metallic = map(luminance, self._fresnel(self._cosine, grazing))
            specular = metal * metallic + (1.0 - metal) * coat
        diffuse = (1.0 - metal) * (1.0 - peak) * base
        if surface.diffuse_transmission is not None and surface.transmission_color is not None:
            factor = surface.diffuse_transmission
            below = factor * luminance(surface.transmission_color)
            both = (1.0 - factor) * base + below
            self._below_share = (below + 1e-9) / (both + 1e-9)
            diffuse = (1.0 - metal) * (1.0 - peak) * both
        if self._sheen is not None:
            over = self._sheen.reflectance
            specular, diffuse = specular * (1.0 - over), diffuse * (1.0 - over) + over
            self._sheen_share = (over + 1e-9) / (diffuse + 1e-9)
        self._specular_share = (specular + 1e-9) / (specular + diffuse + 1e-9)
        if self._clearcoat is not None:
            over = self._clearcoat.reflectance
            self._clearcoat_share = over / (over + (1.0 - over) * (specular + diffuse) + 1e-9)

    def evaluate(self, incoming: Tensor) -> tuple[Tensor, Tensor]:
        """BSDF times |cosine| `[3, N]` and the density `[N]` of `sample`; without diffuse transmission, 0 below the surface."""
        surface = self.surface
        above = (incoming[2] > 0.0).to(torch.float32)
        cosine = incoming[2].clamp(min=MIN_COSINE)
        half = normalize(self._outgoing + incoming)
        towards = dot(self._outgoing, half).clamp(0.0, 1.0)
        grazing = fifth_power(1.0 - towards)
        visibility, microfacet = self._facets.evaluate(half, incoming)
        coat = self._f0 + (self._f90 - self._f0) * grazing
        diffuse = self._leaving * self._passing(incoming, cosine)
        if surface.diffuse_transmission is not None:
            diffuse = diffuse * (1.0 - surface.diffuse_transmission)
        if surface.iridescence is None:
            metallic = surface.base_color + (1.0 - surface.base_color) * grazing
        else:
            coat, metallic = self._fresnel(towards, grazing)
        value = surface.base_color * diffuse + visibility * ((1.0 - surface.metallic) * coat + self._metal * metallic)
        if self._sheen is not None:
            value = value * self._sheen.beneath(cosine) + self._sheen.evaluate(half, cosine)
        share = self._specular_share
        pdf = share * microfacet + self._diffuse_pdf(cosine, above)
        value = value * (cosine * above)
        if self._clearcoat is not None or surface.diffuse_transmission is not None:
            # The density of a lobe includes directions below the lobe's own horizon, where other lobes scatter as well.
            pdf = pdf * (half[2] > 0.0).to(torch.float32)
        if self._clearcoat is not None:
            over, microfacet, beneath, above_coat = self._clearcoat.evaluate(incoming, half, grazing)
            value = value * beneath + over
            pdf = pdf + (microfacet - pdf) * self._clearcoat_share
            above = torch.maximum(above, above_coat)
        if surface.diffuse_transmission is None:
            return value, pdf * above
        through, density = self._transmitted(incoming)
        return value + through, pdf + density

    def _diffuse_pdf(self, cosine: Tensor, above: Tensor) -> Tensor:
        """Density `[N]` of the lobes of sheen and base above the surface, without a clearcoat. above: 1 there, else 0."""
        pdf = (1.0 - self._specular_share) * cosine * (1.0 / math.pi)
        if self.surface.diffuse_transmission is not None:
            pdf = pdf * (1.0 - self._below_share)
        if self._sheen is None:
            return pdf
        return pdf + ((1.0 - self._specular_share) * above * (0.5 / math.pi) - pdf) * self._sheen_share

    def _transmitted(self, incoming: Tensor) -> tuple[Tensor, Tensor]:
        """BTDF times |cosine| `[3, N]` and density `[N]` of diffuse transmission; 0 above the surface."""
        surface = self.surface
        assert surface.diffuse_transmission is not None and surface.transmission_color is not None
        below = (incoming[2] < 0.0).to(torch.float32)
        cosine = incoming[2].abs().clamp(MIN_COSINE, 1.0)
        factor = self._leaving * self._passing(incoming, cosine) * surface.diffuse_transmission * cosine * below
        density = (1.0 - self._specular_share) * self._below_share * cosine * below * (1.0 / math.pi)
        if self._sheen is not None:
            factor, density = factor * self._sheen.beneath(cosine), density * (1.0 - self._sheen_share)
        if self._clearcoat is not None:
            weight, below_coat = self._clearcoat.transmitted(incoming)
            factor, density = factor * weight * below_coat, density * (1.0 - self._clearcoat_share)
        return surface.transmission_color * factor, density

    def sample(self, uniforms: Tensor) -> Tensor:
        """Incoming directions `[3, N]`, possibly below the surface, from uniform numbers `[3, N]`."""
        outgoing, facets, microfacet_share, coat = self._outgoing, self._facets, self._specular_share, self._clearcoat
        if coat is None:
            half = sample_visible_normal(outgoing, facets.alpha, uniforms[1:], facets.along)
        else:
            share = self._clearcoat_share
            over = (uniforms[0] < share).to(torch.float32)
            alpha = facets.alpha + (coat.facets.alpha - facets.alpha) * over
            along = None if facets.along is None else facets.along + (coat.facets.alpha - facets.along) * over
            microfacet_share = share + (1.0 - share) * microfacet_share
            outgoing = outgoing + (coat.outgoing - outgoing) * over
            half = sample_visible_normal(outgoing, alpha, uniforms[1:], along)
            half = half + (coat.from_own(half) - half) * over
        mirrored = 2.0 * dot(self._outgoing, half) * half - self._outgoing
        specular = (uniforms[0] < microfacet_share).to(torch.float32)
        diffuse = self._sample_diffuse(uniforms, microfacet_share)
        return diffuse + (mirrored - diffuse) * specular

    def _sample_diffuse(self, uniforms: Tensor, before: Tensor) -> Tensor:
        """Directions `[3, N]` of the lobes of sheen and base; before: share `[N]` of the lobes before, of the first number."""
        angle, radius = 2.0 * math.pi * uniforms[1], uniforms[2].sqrt()
        height = (1.0 - uniforms[2]).sqrt()
        rest = 1.0 - before
        if self._sheen is not None:
            rest = rest * (1.0 - self._sheen_share)
        if self.surface.diffuse_transmission is not None:
            below = (uniforms[0] >= 1.0 - rest * self._below_share).to(torch.float32)
            height = height * (1.0 - 2.0 * below)
        diffuse = torch.stack((radius * angle.cos(), radius * angle.sin(), height))
        if self._sheen is None:
            return diffuse
        sheen = (uniforms[0] < 1.0 - rest).to(torch.float32)
        return diffuse + (sample_hemisphere(uniforms[1:]) - diffuse) * sheen
