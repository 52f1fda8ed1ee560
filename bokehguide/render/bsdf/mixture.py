"""BSDF of a surface in world space: a mixture of an opaque part and a transmissive part."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.bsdf.dielectric import DielectricBSDF
from bokehguide.render.bsdf.opaque import OpaqueBSDF
from bokehguide.render.surface import Surface
from bokehguide.render.vector import aligned_frame, divisor, dot, tangent_frame, to_local, to_world
from bokehguide.runtime.indexing import ActiveEntries

Frame = tuple[Tensor, Tensor, Tensor]
"""Two tangents and the shading normal, `[3, N]` each."""


class Scattering:
    """The BSDF at the surfaces of a batch; densities are per unit solid angle.

    choice: uniform numbers `[N]` that choose the opaque or the transmissive part for each path; the choice does not change the
    mean. None if no material of the scene transmits light. throughput: of the paths, `[3, N]`, None for white. It chooses the
    channel that refracts in dispersive solids.
    """

    def __init__(self, surface: Surface, choice: Tensor | None, throughput: Tensor | None = None):
        self._frame, self._opaque = _opaque(surface, surface.outgoing)
        self._glass: DielectricBSDF | None = None
        if choice is not None:
            self._chosen = ActiveEntries(choice < surface.transmission)
            if len(self._chosen) > 0:
                self._glass_surface = surface.select(self._chosen.index)
                self._channel: Tensor | None = None
                if surface.dispersion is not None:
                    throughput = torch.ones_like(surface.base_color) if throughput is None else throughput
                    number = self._chosen.select(choice) / divisor(self._glass_surface.transmission)
                    self._channel = disperse(self._glass_surface, self._chosen.select(throughput), number)
                tangent, bitangent, normal = map(self._chosen.select, self._frame)
                self._glass_frame: Frame = tangent, bitangent, normal
                self._glass = DielectricBSDF(to_local(self._glass_surface.outgoing, *self._glass_frame), self._glass_surface)

    def evaluate(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """BSDF times |cosine| `[3, N]` towards world directions, and the density `[N]` of `sample`."""
        local = to_local(direction, *self._frame)
        value, pdf = self._opaque.evaluate(local)
        value = value * _allowed(self._opaque.surface, direction, local[2])
        if self._glass is not None:
            towards = self._chosen.select(direction)
            local = to_local(towards, *self._glass_frame)
            of_glass, density = self._glass.evaluate(local)
            of_glass = of_glass if self._channel is None else of_glass * self._channel
            self._chosen.scatter(pdf, density)
            self._chosen.scatter(value, of_glass * _agree(self._glass_surface, towards, local[2]))
        return value, pdf

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """World directions `[3, N]`, weights BSDF·|cos|/pdf `[3, N]` and densities `[N]`, from uniforms `[3, N]`."""
        local = self._opaque.sample(uniforms)
        value, pdf = self._opaque.evaluate(local)
        direction = to_world(local, *self._frame)
        weight = value / divisor(pdf, 1e-20) * _allowed(self._opaque.surface, direction, local[2])
        if self._glass is not None:
            local, of_glass, density = self._glass.sample(self._chosen.select(uniforms))
            of_glass = of_glass if self._channel is None else of_glass * self._channel
            towards = to_world(local, *self._glass_frame)
            self._chosen.scatter(pdf, density)
            self._chosen.scatter(direction, towards)
            self._chosen.scatter(weight, of_glass * _agree(self._glass_surface, towards, local[2]))
        return direction, weight, pdf


def disperse(surface: Surface, throughput: Tensor, uniform: Tensor) -> Tensor:
    """Choose a channel for each path at solids with dispersion, and set their index of refraction to that of the channel.

    The probability of a channel is its share of the `throughput` `[3, N]`, so that paths keep their channel. Returns factors
    `[3, N]` of the BSDF: 1 / probability in the channel, 0 in the others, and 1 without dispersion. The indices are those of
    KHR_materials_dispersion: Abbe's definition, linear over the channels.
    """
    assert surface.dispersion is not None
    share = (throughput + 1e-9) / (throughput + 1e-9).sum(0)
    red = (uniform < share[0]).to(torch.float32)
    blue = (uniform >= share[0] + share[1]).to(torch.float32) * (1.0 - red)
    chosen = torch.stack((red, 1.0 - red - blue, blue))
    disperses = ((surface.dispersion > 0.0) & (surface.thin == 0.0)).to(torch.float32)
    spread = (surface.ior - 1.0) * (0.025 * surface.dispersion) * disperses
    surface.ior = (surface.ior + spread * (blue - red)).clamp(min=1.0)
    return 1.0 + (chosen / share - 1.0) * disperses


def opaque_values(surface: Surface, outgoing: Tensor, directions: tuple[Tensor, ...]) -> list[Tensor]:
    """BSDF times cosine `[3, N]` of the opaque part for each tensor of world directions `[3, N]`, seen from `outgoing`."""
    frame, opaque = _opaque(surface, outgoing)
    local = [to_local(direction, *frame) for direction in directions]
    return [opaque.evaluate(one)[0] * _allowed(surface, direction, one[2]) for one, direction in zip(local, directions)]


def _opaque(surface: Surface, outgoing: Tensor) -> tuple[Frame, OpaqueBSDF]:
    """The shading frame, and the opaque part of the BSDF as seen from world directions `outgoing` `[3, N]`."""
    normal, along = surface.normal, surface.tangent
    frame = (*(tangent_frame(normal) if along is None else aligned_frame(normal, along)), normal)
    coat = surface.clearcoat_normal
    return frame, OpaqueBSDF(to_local(outgoing, *frame), surface, None if coat is None else to_local(coat, *frame))


def _allowed(surface: Surface, direction: Tensor, above: Tensor) -> Tensor:
    """1 if the opaque part scatters to `direction` `[3, N]`, else 0, `[N]`. The direction must be on the same side of the shading
    normal and of the geometric normal.

    above: cosine between the direction and the shading normal. If a clearcoat has its own normal, either normal is sufficient.
    """
    if surface.clearcoat_normal is not None:
        above = torch.maximum(above, dot(surface.clearcoat_normal, direction))
    return _agree(surface, direction, above)


def _agree(surface: Surface, direction: Tensor, above: Tensor) -> Tensor:
    """1 where `direction` is on the side of the geometric normal that the sign of `above` `[N]` says, else 0."""
    return ((dot(surface.geometric_normal, direction) > 0.0) == (above > 0.0)).to(torch.float32)
