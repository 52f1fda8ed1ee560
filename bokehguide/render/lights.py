"""Next-event estimation: choose a light, a point on it, and know the density."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.clusters import ClusterTable
from bokehguide.render.environment import EnvironmentLight
from bokehguide.render.geometry import Geometry, emitted
from bokehguide.render.kernels import kernel
from bokehguide.render.light_choice import LightChoice, LightClusters
from bokehguide.render.light_grid import GridLamps, LightGrid
from bokehguide.render.pixels import indices, put
from bokehguide.render.suns import cap_directions, frame_about
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.vector import cross, dot, luminance, normalize
from bokehguide.scene.types import Scene

MIN_SHARE = 0.1
"""Neither kind of light gets fewer than this share of the light samples."""
POWER_GRID = 4
"""The power of a textured triangle is averaged over this many squared points."""
CONE_DIRECTIONS = 64
"""That of a spotlight over this many directions within its cone."""
BY_CELL = 0.125
"""Share of the light samples that a `LightChoice` leaves to the cell of the grid, so that no light is ever left out."""
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


class LightSample(NamedTuple):
    """direction: unit, `[3, N]`; distance `[N]`; radiance `[3, N]`; pdf per solid angle `[N]`.

    Under a `LightChoice`, also the cluster that was chosen, whichever way, int32 `[N]`, and the probability of that, `[N]`.
    """

    direction: Tensor
    distance: Tensor
    radiance: Tensor
    pdf: Tensor
    cluster: Tensor | None = None
    share: Tensor | None = None


@dataclass
class LightQuery:
    """N points `[3, N]` to be lit: cells of the grid and their share for the environment, `[N]`; their choice, if they
    have one; and, once it is made under one that has learnt something, which samples leave it to the cell, bool `[N]`,
    and the clusters of the others."""

    points: Tensor
    cells: Tensor
    environment_share: Tensor
    choice: LightChoice | None
    by_cell: Tensor | None = None
    cluster: Tensor | None = None

    @property
    def learnt(self) -> bool:
        return self.choice is not None and self.choice.table is not None

    def select(self, index: Tensor) -> LightQuery:
        names = ("points", "cells", "environment_share", "choice", "by_cell", "cluster")
        values = (getattr(self, name) for name in names)
        return LightQuery(*(v.index_select(-1, index) if isinstance(v, Tensor) else v and v.select(index) for v in values))


class Lights:
    """Emissive triangles (chosen by a `LightGrid`) and what lies at infinity: environment map and suns.

    Each cell of the grid chooses between the two kinds by how much light it may get from
    either. Where a `LightChoice` is given, it chooses among clusters of lights of both kinds in all but
    BY_CELL of the draws. All densities are per unit solid angle at the shaded point and include the choice.
    """

    def __init__(self, scene: Scene, geometry: Geometry):
        self._geometry = geometry
        device = geometry.device
        at_infinity = scene.environment is not None or len(scene.suns) > 0
        self.environment = EnvironmentLight(scene.environment, scene.suns, device) if at_infinity else None
        triangles = indices(geometry.materials.emissive.index_select(0, geometry.material))
        power = _triangle_powers(geometry, triangles) * _cone_cosines(scene, geometry, triangles)
        triangles, power = triangles[power > 0.0], power[power > 0.0]
        self._sky = self.environment.power if self.environment else 0.0
        if len(triangles) > 0:
            self._grid = LightGrid(_grid_lamps(scene, geometry, triangles, power), device)
            triangles = triangles[torch.from_numpy(self._grid.order).to(device)]
            within = self._grid.pdf_within(torch.arange(len(triangles), device=device))
            self._density = within / geometry.areas(triangles)
            corners = geometry.corners(triangles)
            edges = corners[1] - corners[0], corners[2] - corners[0]
            self._rows = torch.cat((corners[0], *edges, geometry.emission_rows(triangles), self._density[None]))  # [14, lamps]
            self._sky_share = (self._sky / (self._sky + self._grid.light)).clamp(MIN_SHARE, 1.0 - MIN_SHARE)
        self._triangles = triangles
        self._lamp = torch.full(geometry.material.shape, -1, device=device)
        self._lamp[triangles] = torch.arange(len(triangles), device=device)

    @property
    def empty(self) -> bool:
        """Whether there is nothing that `sample` could choose."""
        return self._sky == 0.0 and len(self._triangles) == 0

    def environment_share(self, cells: Tensor) -> Tensor:
        """Share of light samples for the environment in cells `[N]`."""
        if self._sky == 0.0:
            return torch.zeros(cells.shape, device=cells.device)
        if len(self._triangles) == 0:
            return torch.ones(cells.shape, device=cells.device)
        return self._sky_share.index_select(0, cells)

    def _cells(self, points: Tensor) -> Tensor:
        if len(self._triangles) == 0:
            return torch.zeros(points.shape[1], dtype=torch.int32, device=points.device)
        return self._grid.cells(points)

    @cached_property
    def clusters(self) -> LightClusters:
        """All that `sample` may fall on, in clusters."""
        return LightClusters(self._grid if len(self._triangles) else None, self.environment if self._sky > 0.0 else None)

    @cached_property
    def _first_far(self) -> Tensor:
        """The first cluster of the environment, `[1]`: made once, as each copy to a device would wait for it."""
        return torch.tensor([self.clusters.triangles], device=self._geometry.device)

    def query(self, points: Tensor, choice: LightChoice | None = None) -> LightQuery:
        """Points `[3, N]` to be lit, for `draw`."""
        cells = self._cells(points)
        return LightQuery(points, cells, self.environment_share(cells), choice)

    def sample(self, points: Tensor, uniforms: Tensor, choice: LightChoice | None = None) -> LightSample:
        """One light sample for each shaded point `[3, N]` from uniform numbers `[6, N]`."""
        return self.draw(self.query(points, choice), uniforms)

    def draw(self, query: LightQuery, uniforms: Tensor) -> LightSample:
        """One light sample for each point of the query from uniform numbers `[6, N]`."""
        sky = uniforms[0] < query.environment_share
        if query.learnt:
            chosen = _learnt(query.choice.table, query.choice.row, query.environment_share, uniforms[0], self._first_far)
            by_cell, sky = chosen[1] > 0.0, chosen[2] > 0.0
            query = replace(query, by_cell=by_cell, cluster=chosen[0])
        if self._sky == 0.0:
            return self._sample_triangles(query, uniforms[1:])
        if len(self._triangles) == 0:
            return self._sample_environment(query, uniforms[1:])
        if sky.device.type != "cpu":  # less work than to wait for how many there are of each kind
            kinds = zip(self._sample_environment(query, uniforms[1:]), self._sample_triangles(query, uniforms[1:]))
            return LightSample(*(None if far is None else torch.where(sky, far, near) for far, near in kinds))
        # The one kind is drawn for all points, and the rarer one then put in its place.
        rare, draw_rare, draw_most = indices(sky), self._sample_environment, self._sample_triangles
        if 2 * len(rare) > len(sky):
            rare, draw_rare, draw_most = indices(~sky), draw_most, draw_rare
        light = draw_most(query, uniforms[1:])
        if len(rare) > 0:
            others = draw_rare(query.select(rare), uniforms[1:].index_select(1, rare))
            for value, other in zip(light, others):
                if value is not None:
                    put(value, rare, other)
        return light

    def _sample_environment(self, query: LightQuery, uniforms: Tensor) -> LightSample:
        element = self.environment.pick(torch.stack((uniforms[0], uniforms[1], uniforms[4])))
        if query.learnt:
            picked = self.clusters.pick(query.cluster.clamp(min=self.clusters.triangles), uniforms[0:2])
            element = torch.where(query.by_cell, element, picked)
        direction = self.environment.directions(element, uniforms[2:4])
        pdf = self._environment_pdf(query, direction, self.environment.texels(direction, element))
        light = LightSample(direction, torch.full_like(pdf, MISS_DISTANCE), self.environment.radiance(direction), pdf)
        if query.choice is None:
            return light
        return light._replace(cluster=self.clusters.cluster(element), share=pdf / self.clusters.pdf_within(element))

    def _environment_pdf(self, query: LightQuery, direction: Tensor, texel: Tensor) -> Tensor:
        by_cell = query.environment_share * self.environment.pdf(direction, texel)
        if not query.learnt:
            return by_cell
        return BY_CELL * by_cell + (1.0 - BY_CELL) * self.clusters.environment_pdf(query.choice, direction, texel)

    def _sample_triangles(self, query: LightQuery, uniforms: Tensor) -> LightSample:
        cluster = self._cluster_of_triangles(query, uniforms[0])
        lamp = self._grid.sample_within(cluster, uniforms[1:3])
        share = self._cluster_share(query, cluster)
        rows = self._rows.index_select(1, lamp)
        direction, distance, u, v, front, pdf, radiance = _on_triangle(rows, query.points, uniforms[3:5], share)
        materials = self._geometry.materials
        if materials.absorbs or materials.has_sheer or not materials.plain_emission:
            hit = Hit(self._triangles.index_select(0, lamp), distance, u, v)
            radiance = self._dimmed(radiance, hit, direction, front)
        light = LightSample(direction, distance, radiance, pdf)
        return light if query.choice is None else light._replace(cluster=cluster, share=share)

    def _dimmed(self, radiance: Tensor, hit: Hit, direction: Tensor, front: Tensor) -> Tensor:
        """What arrives of radiance `[3, N]` at points that see lamps at `hit` in `direction`, if nothing stands between."""
        if not self._geometry.materials.plain_emission:
            radiance = radiance * self._geometry.emission_share(hit, -direction)
        transmittance = self._geometry.transmittance(hit, front)
        if transmittance is not None:
            radiance = radiance * transmittance
        return radiance * self._geometry.opacity(hit) if self._geometry.materials.has_sheer else radiance

    def _cluster_of_triangles(self, query: LightQuery, uniforms: Tensor) -> Tensor:
        """A cluster for each point, from uniform numbers `[N]`, as far as it is not chosen yet."""
        if not query.learnt:
            return self._grid.sample_cluster(query.cells, uniforms)
        if query.by_cell.device.type != "cpu":
            by_cell = self._grid.sample_cluster(query.cells, uniforms)
            return torch.where(query.by_cell, by_cell, query.cluster.clamp(max=self._grid.clusters - 1))
        index = indices(query.by_cell)
        by_cell = self._grid.sample_cluster(query.cells.index_select(0, index), uniforms.index_select(0, index))
        cluster = query.cluster.clamp(max=self._grid.clusters - 1)
        put(cluster, index, by_cell)
        return cluster

    def _cluster_share(self, query: LightQuery, cluster: Tensor) -> Tensor:
        """Probability `[N]` of choosing each of the clusters of triangles."""
        learnt = (query.choice.table, query.choice.row) if query.learnt else None
        return _cluster_share(self._grid.table, query.cells, query.environment_share, learnt, cluster)

    def triangle_pdf(
        self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor, choice: LightChoice | None = None
    ) -> Tensor:
        """Density `[N]` with which `sample` at points `[3, N]` finds `triangle` at `distance` under `cosine`.

        Triangles that emit nothing are never sampled: their density is 0.
        """
        if len(self._triangles) == 0:
            return torch.zeros_like(distance)
        lamp = self._lamp.index_select(0, triangle)
        known = lamp.clamp(min=0)
        share = self._cluster_share(self.query(points, choice), self._grid.cluster(known)) * (lamp >= 0)
        return share * self._density.index_select(0, known) * distance * distance / cosine.abs().clamp(min=1e-12)

    def environment_pdf(self, points: Tensor, directions: Tensor, choice: LightChoice | None = None) -> Tensor:
        """Density `[N]` with which `sample` at points `[3, N]` finds environment directions `[3, N]`."""
        if self._sky == 0.0:
            return torch.zeros_like(directions[0])
        return self._environment_pdf(self.query(points, choice), directions, self.environment.texels(directions))


@kernel
def _learnt(table: ClusterTable, row: Tensor, environment_share: Tensor, uniforms: Tensor, first: Tensor) -> tuple[Tensor, ...]:
    """Clusters `[N]` from uniform numbers `[N]`; 1 where those leave it to the cell, else 0; and 1 where they choose the environment.

    first: its first cluster, `[1]`.
    """
    cluster = table.sample(row, (uniforms - BY_CELL) / (1.0 - BY_CELL))
    by_cell = uniforms < BY_CELL
    sky = torch.where(by_cell, uniforms < BY_CELL * environment_share, cluster >= first)
    return cluster, by_cell.to(torch.float32), sky.to(torch.float32)


@kernel
def _cluster_share(
    by_cell: ClusterTable, cells: Tensor, environment_share: Tensor, learnt: tuple[ClusterTable, Tensor] | None, cluster: Tensor
) -> Tensor:
    """Probability `[N]` of choosing each of the clusters of triangles; learnt: a choice's table and rows."""
    share = (1.0 - environment_share) * by_cell.pdf(cells, cluster)
    if learnt is None:
        return share
    table, row = learnt
    return BY_CELL * share + (1.0 - BY_CELL) * table.pdf(row, cluster)


@kernel
def _on_triangle(rows: Tensor, points: Tensor, uniforms: Tensor, share: Tensor) -> tuple[Tensor, ...]:
    """Points, even over triangles, that light `points` `[3, N]`, from uniform numbers `[2, N]`.

    rows: first corners, edges from them, what `emitted` takes, and with which density, per unit area, the points are drawn
    where the triangle's cluster is, `[14, N]`; share: the probability of that cluster, `[N]`. Unit directions `[3, N]`;
    distances, barycentric u and v, 1 where the front is seen, else 0, and densities per unit solid angle, `[N]` each; and
    what their materials emit, `[3, N]`.
    """
    root = uniforms[0].sqrt()
    u, v = root * (1.0 - uniforms[1]), root * uniforms[1]
    first, second = rows[3:6], rows[6:9]
    offset = rows[0:3] + u * first + v * second - points
    squared = dot(offset, offset).clamp(min=1e-30)
    distance = squared.sqrt()
    direction = offset / distance
    cosine = -dot(normalize(cross(first, second)), direction)
    front = (cosine > 0.0).to(torch.float32)
    pdf = share * rows[13] * squared / cosine.abs().clamp(min=1e-12)
    return direction, distance, u, v, front, pdf, emitted(rows[9:13], front)


def _grid_lamps(scene: Scene, geometry: Geometry, triangles: Tensor, power: Tensor) -> GridLamps:
    material = geometry.material.index_select(0, triangles).cpu().numpy()
    cones = [m.emission_cone for m in scene.materials]
    return GridLamps(
        center=geometry.corners(triangles).mean(0).T.cpu().numpy(),
        normal=geometry.face_normals(triangles).T.cpu().numpy(),
        power=power.cpu().numpy(),
        double_sided=(geometry.is_double_sided(triangles) > 0.0).cpu().numpy(),
        axis=np.array([cone.axis if cone else (0.0, 0.0, 0.0) for cone in cones])[material],
        outer=np.array([math.radians(cone.outer) if cone else math.pi for cone in cones])[material],
    )


def _cone_cosines(scene: Scene, geometry: Geometry, triangles: Tensor) -> Tensor:
    """Mean cosine `[K]` under which light leaves triangles of spotlights for their cones, 1 for all others.

    So the far side of a spherical spotlight, which shines nowhere, has no power.
    """
    material = geometry.material.index_select(0, triangles)
    cosines = torch.ones(len(triangles), device=geometry.device)
    spots = [(number, m.emission_cone) for number, m in enumerate(scene.materials) if m.emission_cone]
    places = (torch.arange(CONE_DIRECTIONS, device=geometry.device) + 0.5) / CONE_DIRECTIONS
    places = torch.stack((places, places * (CONE_DIRECTIONS * GOLDEN) % 1.0))
    for number, cone in spots:
        height = 2.0 * math.sin(math.radians(cone.outer) / 2.0) ** 2
        directions = cap_directions(frame_about(cone.axis).to(geometry.device), height, places)
        share = geometry.materials.cone(torch.full((CONE_DIRECTIONS,), number, device=geometry.device), directions)
        index = indices(material == number)
        leaving = geometry.face_normals(triangles[index]).T @ directions
        leaving = leaving.abs() if scene.materials[number].double_sided else leaving.clamp(min=0.0)
        cosines[index] = leaving @ (share / share.sum())
    return cosines


def _triangle_powers(geometry: Geometry, triangles: Tensor) -> Tensor:
    """Area times mean emitted luminance of each triangle, both faces of a double-sided one."""
    if len(triangles) == 0:
        return torch.zeros(0, device=geometry.device)
    grid = (torch.arange(POWER_GRID, device=geometry.device) + 0.5) / POWER_GRID
    total = torch.zeros(len(triangles), device=geometry.device)
    ones = torch.ones_like(total)
    for a in grid.tolist():
        for b in grid.tolist():
            root = math.sqrt(a)
            hit = Hit(triangles, ones, ones * (root * (1.0 - b)), ones * (root * b))
            total += luminance(geometry.emission(hit, ones, None)) * geometry.opacity(hit)
    faces = 1.0 + geometry.is_double_sided(triangles)
    return total / POWER_GRID**2 * geometry.areas(triangles) * faces
