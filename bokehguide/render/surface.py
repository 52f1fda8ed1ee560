"""Surfaces that paths hit, with the parameters that BSDFs read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bokehguide.render.vector import dot

MIN_ALPHA = 1e-3
"""Least GGX α of an opaque surface. Smoother surfaces would look the same: like mirrors."""
SMOOTH_ALPHA = 4e-3
"""Least α of a rough transmissive surface (roughness 0.063). Smoother surfaces have delta reflection and delta refraction."""


@dataclass
class Surface:
    """Surfaces that N paths hit, as component arrays; all vectors are in world space.

    outgoing: unit direction back along the ray. geometric_normal, normal (shading normal): on the side of `outgoing`. front: 1 if
    the ray meets the front of the triangle, else 0, float32. offset: distance of the origins of new rays from the surface, along
    ±geometric_normal. facing: 0 if the shading normal faced away from `outgoing`, so that another normal replaced it, else 1,
    float32. alpha, clearcoat_alpha: GGX α. tangent: the direction, not always perpendicular to the normal, along which
    anisotropic microfacets have the larger α `alpha_along`; 0 if unknown. transmission: share of the transmissive part. metallic:
    share of metal in the opaque part. transmission_color: of the diffuse transmission.
    iridescence: share of the thin film with `film_ior` and `film_thickness` (nm). dispersion: 20 / Abbe number.
    single_scattering: 1 for metals without multiple scattering between microfacets, else 0, float32.

    Optional fields are None if no material of the scene needs them: specular colours other than white, clearcoats, sheens,
    anisotropy, diffuse transmission, films, dispersion, and single scattering. clearcoat_normal is also None if every clearcoat
    has the normal of the layers beneath.
    """

    position: Tensor
    outgoing: Tensor
    geometric_normal: Tensor
    normal: Tensor
    front: Tensor
    offset: Tensor
    facing: Tensor
    base_color: Tensor
    metallic: Tensor
    alpha: Tensor
    specular: Tensor
    transmission: Tensor
    thin: Tensor
    ior: Tensor
    specular_color: Tensor | None = None
    clearcoat: Tensor | None = None
    clearcoat_alpha: Tensor | None = None
    clearcoat_normal: Tensor | None = None
    sheen_color: Tensor | None = None
    sheen_roughness: Tensor | None = None
    tangent: Tensor | None = None
    alpha_along: Tensor | None = None
    diffuse_transmission: Tensor | None = None
    transmission_color: Tensor | None = None
    iridescence: Tensor | None = None
    film_ior: Tensor | None = None
    film_thickness: Tensor | None = None
    dispersion: Tensor | None = None
    single_scattering: Tensor | None = None

    def select(self, index: Tensor) -> Surface:
        """Surfaces at `index`, int64 `[M]`."""
        fields = vars(self).items()
        selected: dict[str, Any] = {name: None if x is None else x.index_select(-1, index) for name, x in fields}
        return Surface(**selected)

    def leave(self, direction: Tensor) -> Tensor:
        """Origins `[3, N]` of new rays, offset from the surface to the side of `direction`."""
        side = torch.sign(dot(self.geometric_normal, direction))
        return self.position + self.geometric_normal * (side * self.offset)
