"""The layer of KHR_materials_clearcoat."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.bsdf.coat_albedo import CoatAlbedo
from bokehguide.render.bsdf.microfacets import MIN_COSINE, Microfacets
from bokehguide.render.materials import CLEARCOAT_F0
from bokehguide.render.surface import Surface
from bokehguide.render.vector import fifth_power, tangent_frame, to_local, to_world


class Clearcoat:
    """The layer of KHR_materials_clearcoat.

    normal: local `[3, N]`, None for the normal of the layers beneath. `outgoing` is in the frame of the clearcoat's normal.
    """

    def __init__(self, outgoing: Tensor, surface: Surface, normal: Tensor | None):
        assert surface.clearcoat is not None and surface.clearcoat_alpha is not None
        self._frame = None if normal is None else (*tangent_frame(normal), normal)
        self.outgoing = self._to_own(outgoing)
        cosine = self.outgoing[2].clamp(min=MIN_COSINE)
        self._weight = surface.clearcoat
        self.facets = Microfacets(self.outgoing, surface.clearcoat_alpha)
        self._albedo = CoatAlbedo(self.facets, self._weight * CLEARCOAT_F0, self._weight * (1.0 - CLEARCOAT_F0))
        self._leaving = self._passing(self.outgoing, cosine)
        self.reflectance = self._weight * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * fifth_power(1.0 - cosine))
        """Approximate albedo, from which the probability of sampling the clearcoat follows."""

    def _to_own(self, direction: Tensor) -> Tensor:
        return direction if self._frame is None else to_local(direction, *self._frame)

    def from_own(self, direction: Tensor) -> Tensor:
        """Directions `[3, N]` converted from the frame of the clearcoat's normal to the frame of the surface."""
        return direction if self._frame is None else to_world(direction, *self._frame)

    def _passing(self, direction: Tensor, cosine: Tensor) -> Tensor:
        """Transmittance 1 - T of the clearcoat for directions `[3, N]` with the cosine `cosine` `[N]` to the normal."""
        return 1.0 - self._albedo.towards(direction, cosine)

    def evaluate(self, incoming: Tensor, half: Tensor, grazing: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """BRDF times cosine, density, weight of the layers beneath, and 1 above the clearcoat's horizon, else 0; `[N]` each.

        grazing: (1 - outgoing · half)⁵.
        """
        incoming, half = self._to_own(incoming), self._to_own(half)
        above = (incoming[2] > 0.0).to(torch.float32)
        cosine = incoming[2].clamp(min=MIN_COSINE)
        visibility, pdf = self.facets.evaluate(half, incoming)
        value = self._weight * visibility * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * grazing)
        beneath = torch.minimum(self._leaving, self._passing(incoming, cosine))
        return value * (cosine * above), pdf * (half[2] > 0.0).to(torch.float32), beneath, above

    def transmitted(self, incoming: Tensor) -> tuple[Tensor, Tensor]:
        """Weight of light from below the surface, and 1 below the clearcoat's horizon, else 0; `[N]` each."""
        own = self._to_own(incoming)
        passing = self._passing(own, own[2].abs().clamp(max=1.0))
        return torch.minimum(self._leaving, passing), (own[2] <= 0.0).to(torch.float32)
