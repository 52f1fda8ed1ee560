"""How a surface scatters: the opaque and the transmissive part joined, in world space."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.bsdf import OpaqueBSDF
from bokehguide.render.dielectric import DielectricBSDF
from bokehguide.render.geometry import Surface
from bokehguide.render.vector import dot, tangent_frame, to_local, to_world


class Scattering:
    """The BSDF at the surfaces of a batch; densities are per unit solid angle.

    A partly transmissive material is the mixture of an opaque and a glass one: `choice`,
    uniform numbers `[N]`, picks one of them for each path, which leaves the mean unchanged.
    None says that nothing in the scene transmits.
    """

    def __init__(self, surface: Surface, choice: Tensor | None):
        self._surface = surface
        self._frame = (*tangent_frame(surface.normal), surface.normal)
        outgoing = to_local(surface.outgoing, *self._frame)
        coat = surface.clearcoat_normal
        self._opaque = OpaqueBSDF(outgoing, surface, None if coat is None else to_local(coat, *self._frame))
        self._glass = None
        if choice is not None:
            index = (choice < surface.transmission * (1.0 - surface.metallic)).nonzero()[:, 0]
            if len(index) > 0:
                self._glass_index = index
                self._glass = DielectricBSDF(outgoing.index_select(1, index), surface.select(index))

    def _allowed(self, direction: Tensor, above: Tensor) -> Tensor:
        """1 where shading and geometric normal agree on the side of `direction`, else 0.

        above: the direction's cosine to the shading normal. Where a clear coat has a normal of
        its own either may agree: each lobe ends at its own horizon.
        """
        if self._surface.clearcoat_normal is not None:
            cosine, above = above, torch.maximum(above, dot(self._surface.clearcoat_normal, direction))
            if self._glass is not None:
                above[self._glass_index] = cosine[self._glass_index]
        return ((dot(self._surface.geometric_normal, direction) > 0.0) == (above > 0.0)).to(torch.float32)

    def evaluate(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """BSDF times |cosine| `[3, N]` towards world directions, and the density `[N]` of `sample`."""
        local = to_local(direction, *self._frame)
        value, pdf = self._opaque.evaluate(local)
        if self._glass is not None:
            index = self._glass_index
            value[:, index], pdf[index] = self._glass.evaluate(local.index_select(1, index))
        return value * self._allowed(direction, local[2]), pdf

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """World directions `[3, N]`, weights BSDF·|cos|/pdf `[3, N]` and densities `[N]`, from uniforms `[3, N]`."""
        local = self._opaque.sample(uniforms)
        value, pdf = self._opaque.evaluate(local)
        weight = value / pdf.clamp(min=1e-20)
        if self._glass is not None:
            index = self._glass_index
            local[:, index], weight[:, index], pdf[index] = self._glass.sample(uniforms.index_select(1, index))
        direction = to_world(local, *self._frame)
        return direction, weight * self._allowed(direction, local[2]), pdf
