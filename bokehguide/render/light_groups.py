"""Radiance of each light group along the rays of a trace."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.base import DirectLight
from bokehguide.render.lights.environment import EnvironmentLight
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.render.observer import PathObserver
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.scene.light_groups import LightGroups


class GroupedLights:
    """The light group of each emitter of a scene.

    count: number of groups. materials: group of each material, int32 `[M]`. map, distant: groups of the environment map and of
    each distant light.
    """

    def __init__(self, groups: LightGroups, geometry: Geometry, lights: Lights):
        self._geometry, self._environment = geometry, lights.environment
        self.count = len(groups.names)
        self.materials = torch.tensor(groups.materials or (0,), dtype=torch.int32, device=geometry.device)
        self.map = groups.environment
        self.distant = [groups.suns[number] for number in lights.environment.numbers] if lights.environment else []

    def of_triangles(self, triangle: Tensor) -> Tensor:
        """Groups of triangles, int32 `[N]`."""
        return self.materials.index_select(0, self._geometry.material.index_select(0, triangle))

    def parts(self, radiance: Tensor, triangle: Tensor | None, direction: Tensor) -> Tensor:
        """`radiance` `[3, N]` from emitters by groups, `[groups, 3, N]`.

        triangle: int32 `[N]`, -1 for lights at infinity, None if all are. direction: unit, towards the emitters, `[3, N]`.
        """
        far = self._far_shares(direction, self._environment) if self._environment is not None else None
        if triangle is None:
            assert far is not None
            return far * radiance
        near = triangle >= 0
        group = torch.where(near, self.of_triangles(triangle.clamp(min=0)), -1)
        numbers = torch.arange(self.count, dtype=torch.int32, device=group.device)
        parts = torch.where((group == numbers[:, None])[:, None], radiance, 0.0)
        return parts if far is None else torch.where(near, parts, far * radiance)

    def _far_shares(self, direction: Tensor, environment: EnvironmentLight) -> Tensor:
        """Shares of the groups in the radiance from unit directions `[3, N]`, `[groups, 3, N]`."""
        parts = torch.zeros(self.count, *direction.shape, device=direction.device)
        if environment.map is not None:
            parts[self.map] += environment.map.radiance(direction)
        for group, light in zip(self.distant, environment.distant):
            parts[group] += light.radiance * light.contains(direction)
        total = environment.radiance(direction)
        return torch.where(total > 0.0, parts / torch.where(total > 0.0, total, 1.0), 0.0)


@dataclass
class GroupRadiance(PathObserver):
    """Radiance of G light groups in one trace of N rays. The sum over the groups is the radiance of the trace.

    rays: along the rays, `[G, 3, N]`. reflected: that the light sample, and then the BSDF sample, of each of P split paths adds
    along the ray, `[G, 6, P]`, None without splits. The observer fills the arrays where PyTorch traces the paths.
    """

    groups: GroupedLights
    rays: Tensor
    reflected: Tensor | None = None

    @staticmethod
    def empty(groups: GroupedLights, rays: int, device: torch.device) -> GroupRadiance:
        return GroupRadiance(groups, torch.zeros(groups.count, 3, rays, device=device))

    def make_paths(self, count: int) -> None:
        """Make the array of P split paths."""
        self.reflected = torch.zeros(self.groups.count, 6, count, device=self.rays.device)

    def core_arrays(self) -> dict[str, Tensor]:
        """The arrays that the native core fills, and the groups of the emitters, by the names of `LightGroups`."""
        far = torch.tensor([self.groups.map, *self.groups.distant], dtype=torch.int32)
        arrays = {"rays": self.rays, "materials": self.groups.materials, "far": far}
        return arrays if self.reflected is None else arrays | {"reflected": self.reflected}

    def split(self, rays: Tensor) -> None:
        """See `PathObserver`."""
        self.make_paths(len(rays))
        self._path_rays, self._at_primary_hits = rays, True

    def emitter(self, paths: Tensor, radiance: Tensor, triangle: Tensor | None, direction: Tensor) -> None:
        """See `PathObserver`."""
        self._add(self.rays if self.reflected is None else self.reflected[:, 3:], paths, radiance, triangle, direction)

    def light_sample(self, paths: Tensor, light: DirectLight, contribution: Tensor, visibility: Tensor) -> None:
        """See `PathObserver`."""
        sums = self.rays
        if self.reflected is not None:
            sums = self.reflected[:, :3] if self._at_primary_hits else self.reflected[:, 3:]
        self._add(sums, paths, contribution, light.triangle, light.direction)

    def scattered(self, direction: Tensor, pdf: Tensor) -> None:
        """See `PathObserver`."""
        self._at_primary_hits = False

    def finished(self, radiance: Tensor, distance: Tensor) -> None:
        """See `PathObserver`."""
        if self.reflected is not None:
            self.rays.index_add_(2, self._path_rays, self.reflected[:, :3] + self.reflected[:, 3:])

    def hits(self, hits: PrimaryHits, group: int) -> PrimaryHits:
        """The primary hits of the trace with the light of one group alone."""
        assert self.reflected is not None
        direct, indirect = self.reflected[group].split(3)
        emits = (self.groups.of_triangles(hits.hit.triangle) == group).to(torch.float32)
        found = hits.geometry, hits.rays, hits.hit, hits.surface, hits.emission * emits, hits.counts, hits.owner
        alone = PrimaryHits(*found, indirect)
        alone.direct, alone.emits = direct, emits
        alone.light_direction, alone.scattered_direction = hits.light_direction, hits.scattered_direction
        return alone

    def _add(self, sums: Tensor, paths: Tensor, radiance: Tensor, triangle: Tensor | None, direction: Tensor) -> None:
        sums.index_add_(2, paths, self.groups.parts(radiance, triangle, direction))
