"""Record of primary hits and of their incident light, from which the surfaces can be shaded as seen from other lens points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.bsdf.mixture import opaque_values
from bokehguide.render.geometry import MIN_FACING, Geometry
from bokehguide.render.surface import Surface
from bokehguide.render.tracer import Hit
from bokehguide.render.vector import dot

FAINTEST = 1e-20
"""Least BSDF value as a divisor. Smaller values are treated as 0, because the quotient of radiance and BSDF would overflow."""
Pair = tuple[Tensor, Tensor]


class CoreRecord(NamedTuple):
    """Primary hits in the native core. arrays: by the names of `SplitRecord` in `native/tables.h`. hits, paths:
    how many are in use."""

    arrays: dict[str, Tensor]
    hits: int
    paths: int


@dataclass
class PrimaryHits:
    """Primary hits of K rays that split into P paths, and the incident light of each path.

    rays: int64 `[K]`, ascending. hit, surface: `[K]`. emission: towards the origins of the rays, `[3, K]`. counts: number of
    paths of each ray, int64 `[K]`. owner: primary hit of each path, int64 `[P]`, ascending. light_direction: unit direction of
    the light sample, `[3, P]`. direct: radiance that the light sample adds along the ray, `[3, P]`. scattered_direction: unit
    direction of the BSDF sample, `[3, P]`. indirect: radiance that the BSDF sample adds along the ray, `[3, P]`.
    """

    geometry: Geometry
    rays: Tensor
    hit: Hit
    surface: Surface
    emission: Tensor
    counts: Tensor
    owner: Tensor
    indirect: Tensor

    def __post_init__(self) -> None:
        self.direct, self.light_direction = torch.zeros_like(self.indirect), self.path_surface.normal
        self.scattered_direction = self.path_surface.normal
        self._reflection: tuple[Pair, Pair] | None = None
        self.emits: Tensor | None = None
        """1 for hits whose emission counts, else 0, `[K]`; None if all emission counts."""
        self._normals: list[Tensor] | None = None

    @cached_property
    def path_surface(self) -> Surface:
        """Surface of each path's hit, `[P]`."""
        return self.surface.select(self.owner)

    @cached_property
    def path_rays(self) -> Tensor:
        """Ray of each path, int64 `[P]`."""
        return self.rays.index_select(0, self.owner)

    def core_record(self) -> CoreRecord | None:
        """The record in the native core, None if PyTorch has recorded the hits."""
        return None

    def same_normals(self, chosen: Tensor, outgoing: Tensor) -> Tensor:
        """Whether the surfaces `chosen`, int64 `[J]`, have the same shading normals from unit directions `[3, J]`; bool `[J]`.

        Valid only for surfaces of which the ray's own view has not replaced a shading normal.
        """
        normals = self._normals = self._normals or self.geometry.own_normals(self.surface, self.hit)
        facing = [dot(normal.index_select(1, chosen), outgoing) > MIN_FACING for normal in normals]
        return torch.stack(facing).all(0)

    @property
    def directions(self) -> Pair:
        """Unit directions `[3, P]` of each path's light sample and BSDF sample."""
        return self.light_direction, self.scattered_direction

    @property
    def reflection(self) -> tuple[Pair, Pair]:
        """BSDF times cosine, and incident light over the density of the direction: `[3, P]` for each of `directions`.

        Products of both are the radiance along the ray. The incident light is 0 where the BSDF is too small as a divisor.
        """
        if self._reflection is None:
            values = opaque_values(self.path_surface, self.path_surface.outgoing, self.directions)
            light = zip(values, (self.direct, self.indirect))
            incident = [torch.where(value > FAINTEST, reflected / value, 0.0) for value, reflected in light]
            self._reflection = ((values[0], values[1]), (incident[0], incident[1]))
        return self._reflection

    def paths_of(self, chosen: Tensor, count: int) -> Pair:
        """The paths of the surfaces `chosen`, int64 `[J]`: indices into `chosen`, and paths, int64 `[Q]` each.

        count: total number Q of these paths.
        """
        counts = self.counts.index_select(0, chosen)
        viewer = torch.repeat_interleave(counts, output_size=count)
        first = (self.counts.cumsum(0) - self.counts).index_select(0, chosen) - (counts.cumsum(0) - counts)
        return viewer, torch.arange(len(viewer), device=viewer.device) + first.index_select(0, viewer)

    def bsdf(self, paths: Tensor, outgoing: Tensor) -> Pair:
        """BSDF times cosine `[3, Q]` for the directions of `paths`, int64 `[Q]`, seen from unit directions `[3, Q]`.

        Partly transmissive surfaces are not supported. Shading normals come from the view of the rays (`same_normals`).
        """
        directions = tuple(direction.index_select(1, paths) for direction in self.directions)
        light, scattered = opaque_values(self.path_surface.select(paths), outgoing, directions)
        return light, scattered

    def emitted(self, chosen: Tensor, outgoing: Tensor) -> Tensor:
        """Emission `[3, J]` of the surfaces `chosen`, int64 `[J]`, towards unit directions `[3, J]`."""
        if self.geometry.materials.plain_emission:
            return self.emission.index_select(1, chosen)
        hit = Hit(*(field.index_select(0, chosen) for field in self.hit))
        emission = self.geometry.emission(hit, self.surface.front.index_select(0, chosen), outgoing)
        return emission if self.emits is None else emission * self.emits.index_select(0, chosen)
