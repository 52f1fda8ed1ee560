"""How a surface scatters: the opaque and the transmissive part joined, in world space."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.bsdf import OpaqueBSDF
from bokehguide.render.dielectric import DielectricBSDF
from bokehguide.render.geometry import Surface
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import put_where, worthwhile
from bokehguide.render.vector import dot, tangent_frame, to_local, to_world


class Scattering:
    """The BSDF at the surfaces of a batch; densities are per unit solid angle.

    A partly transmissive material is the mixture of an opaque and a glass one: `choice`,
    uniform numbers `[N]`, picks one of them for each path, which leaves the mean unchanged.
    None says that nothing in the scene transmits.
    """

    def __init__(self, surface: Surface, choice: Tensor | None):
        self._frame, self._opaque = _prepared(surface)
        self._opaque.surface = surface
        self._glass = None
        if choice is not None:
            glass = choice < surface.transmission * (1.0 - surface.metallic)
            index = worthwhile(glass)
            if len(index) > 0:
                self._glass_index, self._is_glass = index, glass.index_select(0, index)
                self._glass_surface = surface.select(index)
                self._glass_frame = tuple(axis.index_select(1, index) for axis in self._frame)
                self._glass = DielectricBSDF(to_local(self._glass_surface.outgoing, *self._glass_frame), self._glass_surface)

    def evaluate(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """BSDF times |cosine| `[3, N]` towards world directions, and the density `[N]` of `sample`."""
        value, pdf = _evaluated(self._frame, self._opaque, direction)
        if self._glass is not None:
            index = self._glass_index
            towards = direction.index_select(1, index)
            local = to_local(towards, *self._glass_frame)
            of_glass, density = self._glass.evaluate(local)
            put_where(self._is_glass, pdf, index, density)
            put_where(self._is_glass, value, index, of_glass * _agree(self._glass_surface, towards, local[2]))
        return value, pdf

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """World directions `[3, N]`, weights BSDF·|cos|/pdf `[3, N]` and densities `[N]`, from uniforms `[3, N]`."""
        direction, weight, pdf = _sampled(self._frame, self._opaque, uniforms)
        if self._glass is not None:
            index = self._glass_index
            local, of_glass, density = self._glass.sample(uniforms.index_select(1, index))
            towards = to_world(local, *self._glass_frame)
            put_where(self._is_glass, pdf, index, density)
            put_where(self._is_glass, direction, index, towards)
            put_where(self._is_glass, weight, index, of_glass * _agree(self._glass_surface, towards, local[2]))
        return direction, weight, pdf


def opaque_values(surface: Surface, outgoing: Tensor, directions: tuple[Tensor, ...]) -> list[Tensor]:
    """BSDF times cosine `[3, N]` of the opaque part towards each of some world directions `[3, N]`, seen from `outgoing` and
    not as `surface` was."""
    frame, opaque = _opaque(surface, outgoing)
    local = [to_local(direction, *frame) for direction in directions]
    return [opaque.evaluate(one)[0] * _allowed(surface, direction, one[2]) for one, direction in zip(local, directions)]


Frame = tuple[Tensor, Tensor, Tensor]
"""Two tangents and the shading normal, `[3, N]` each."""


@kernel
def _prepared(surface: Surface) -> tuple[Frame, OpaqueBSDF]:
    """The shading frame, and the opaque part of the BSDF without its surface, which need not come out again."""
    (*tangents, normal), opaque = _opaque(surface, surface.outgoing)
    opaque.surface = None
    return (*tangents, normal.clone()), opaque


def _opaque(surface: Surface, outgoing: Tensor) -> tuple[Frame, OpaqueBSDF]:
    """The shading frame, and the opaque part of the BSDF as seen from world directions `outgoing` `[3, N]`."""
    frame = (*tangent_frame(surface.normal), surface.normal)
    coat = surface.clearcoat_normal
    return frame, OpaqueBSDF(to_local(outgoing, *frame), surface, None if coat is None else to_local(coat, *frame))


@kernel
def _evaluated(frame: Frame, opaque: OpaqueBSDF, direction: Tensor) -> tuple[Tensor, Tensor]:
    local = to_local(direction, *frame)
    value, pdf = opaque.evaluate(local)
    return value * _allowed(opaque.surface, direction, local[2]), pdf


@kernel
def _sampled(frame: Frame, opaque: OpaqueBSDF, uniforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    local = opaque.sample(uniforms)
    value, pdf = opaque.evaluate(local)
    direction = to_world(local, *frame)
    return direction, value / pdf.clamp(min=1e-20) * _allowed(opaque.surface, direction, local[2]), pdf


def _allowed(surface: Surface, direction: Tensor, above: Tensor) -> Tensor:
    """1 where shading and geometric normal agree on the side of `direction`, else 0, for the opaque part.

    above: the direction's cosine to the shading normal. Where a clear coat has a normal of
    its own either may agree: each lobe ends at its own horizon.
    """
    if surface.clearcoat_normal is not None:
        above = torch.maximum(above, dot(surface.clearcoat_normal, direction))
    return _agree(surface, direction, above)


def _agree(surface: Surface, direction: Tensor, above: Tensor) -> Tensor:
    return ((dot(surface.geometric_normal, direction) > 0.0) == (above > 0.0)).to(torch.float32)
