"""The first surfaces that rays meet, and what the light that paths find there is for others who look at them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bokehguide.render.geometry import MIN_FACING, Geometry, Surface
from bokehguide.render.kernels import kernel
from bokehguide.render.scattering import opaque_values
from bokehguide.render.tracer import Hit
from bokehguide.render.vector import dot

FAINTEST = 1e-20
"""BSDFs of less count as none."""
Ways = tuple[Tensor, Tensor]


@dataclass
class FirstSurfaces:
    """First surfaces of K rays, where these split into P paths, and the light that each path found.

    index: the rays, int64 `[K]`, ascending; hit, met: the surfaces, `[K]`; emission: what they emit towards the rays'
    origins, `[3, K]`; owner: of which of them each path is, int64 `[P]`, ascending; surface: the same surfaces once for each
    path; parts: into how many each ray split, int64 `[K]`. Of each path, `[3, P]`: towards_light, the unit direction of its light
    sample, and direct, the radiance that this brought along the ray; onward, the direction in which it went on, and indirect, what
    came from there.
    """

    geometry: Geometry
    index: Tensor
    hit: Hit
    met: Surface
    emission: Tensor
    owner: Tensor
    surface: Surface
    parts: Tensor
    indirect: Tensor
    direct: Tensor | None = None
    towards_light: Tensor | None = None
    onward: Tensor | None = None

    def __post_init__(self) -> None:
        self.rays = self.index.index_select(0, self.owner)
        """Ray of each path, int64 `[P]`."""
        if self.direct is None:  # without lights to sample
            self.direct, self.towards_light = torch.zeros_like(self.indirect), self.surface.normal
        self._incident: tuple[Tensor, Tensor] | None = None
        self._normals: list[Tensor] | None = None

    def same_normals(self, chosen: Tensor, outgoing: Tensor) -> Tensor:
        """Whether surfaces at `chosen`, int64 `[J]`, where no shading normal has given way, keep theirs as seen from unit directions
        `[3, J]`; bool `[J]`."""
        if self._normals is None:
            self._normals = self.geometry.own_normals(self.met, self.hit)
        facing = [dot(normal.index_select(1, chosen), outgoing) > MIN_FACING for normal in self._normals]
        return torch.stack(facing).all(0)

    def radiance(self, chosen: Tensor, outgoing: Tensor, count: int) -> Tensor:
        """Radiance `[3, J]` of the surfaces at `chosen`, int64 `[J]`, towards unit directions `[3, J]`; count: of all their paths.

        It is an unbiased estimate for any direction above the surface, from the same incident light; the smoother the surface,
        the noisier. Of partly transmissive surfaces it is none. Shading normals are those of the rays' own view (`same_normals`).
        """
        if self._incident is None:
            ways = (self.towards_light, self.onward)
            self._incident = _incident(self.surface, self.surface.outgoing, ways, (self.direct, self.indirect))
        counts = self.parts.index_select(0, chosen)
        asked = torch.repeat_interleave(counts, output_size=count)
        first = (self.parts.cumsum(0) - self.parts).index_select(0, chosen) - (counts.cumsum(0) - counts)
        paths = torch.arange(len(asked), device=asked.device) + first.index_select(0, asked)
        surface = self.surface.select(paths)
        ways, incident = (
            tuple(part.index_select(1, paths) for part in pair) for pair in ((self.towards_light, self.onward), self._incident)
        )
        scattered = _leaving(surface, outgoing.index_select(1, asked), ways, incident)
        return self._emitted(chosen, outgoing).index_add_(1, asked, scattered)

    def _emitted(self, chosen: Tensor, outgoing: Tensor) -> Tensor:
        if self.geometry.materials.plain_emission:
            return self.emission.index_select(1, chosen)
        hit = Hit(*(field.index_select(0, chosen) for field in self.hit))
        return self.geometry.emission(hit, self.met.front.index_select(0, chosen), outgoing)


@kernel
def _incident(surface: Surface, outgoing: Tensor, ways: Ways, brought: Ways) -> Ways:
    """What was there to be scattered, `[3, P]`, given what was scattered of it; 0 where the surface scatters nothing of it."""
    values = opaque_values(surface, outgoing, ways)
    first, second = (torch.where(value > FAINTEST, light / value, 0.0) for value, light in zip(values, brought))
    return first, second


@kernel
def _leaving(surface: Surface, outgoing: Tensor, ways: Ways, incident: Ways) -> Tensor:
    """Scattered radiance `[3, P]`."""
    first, second = opaque_values(surface, outgoing, ways)
    return first * incident[0] + second * incident[1]
