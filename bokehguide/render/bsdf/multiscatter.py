"""Light that the microfacets of metals scatter more than once.

Single scattering loses the light that a facet reflects onto another facet: about half of it for α = 1. The BRDF of a metal
therefore has the factor 1 + G (1 / S(outgoing) - 1), with the albedo S of microfacets that reflect all light (Turquin 2019). The
colour G of the further reflections is F M / (1 - F (1 - M)), with the means F of the reflectance and M of S under uniform
illumination (Kulla and Conty 2017). Cycles has the same factor. A white metal reflects all light at every angle.

The factor depends on the direction of the viewer alone. The weights of samples therefore stay below 1 / S. Metals are not
reciprocal, but all paths start at the camera.
"""

from __future__ import annotations

from torch import Tensor

from bokehguide.render.bsdf.coat_albedo import CoatAlbedo
from bokehguide.render.surface import Surface

MEAN_GRAZING = 1.0 / 21.0
"""Mean of (1 - cos θ)⁵ under uniform illumination."""


def metal_gain(surface: Surface, perfect: CoatAlbedo, outgoing: Tensor, cosine: Tensor) -> Tensor:
    """Factor `[3, N]` of the single scattering of metals.

    perfect: albedo of microfacets that reflect all light. outgoing: local `[3, N]`, with the cosine `cosine` `[N]` to the normal.
    """
    reflectance, mean = surface.base_color + (1.0 - surface.base_color) * MEAN_GRAZING, perfect.mean()
    lost = 1.0 / perfect.towards(outgoing, cosine) - 1.0
    if surface.single_scattering is not None:
        lost = lost * (1.0 - surface.single_scattering)
    return 1.0 + lost * (reflectance * mean / (1.0 - reflectance * (1.0 - mean)))
