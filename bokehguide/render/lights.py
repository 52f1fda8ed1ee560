"""Next-event estimation: choose a light, a point on it, and know the density."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.environment import EnvironmentLight
from bokehguide.render.geometry import Geometry, emitted
from bokehguide.render.kernels import kernel
from bokehguide.render.light_choice import LightChoice, LightClusters
from bokehguide.render.light_grid import GridLamps, LightGrid
from bokehguide.render.pixels import put
from bokehguide.render.suns import cap_directions, frame_about
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.vector import dot, luminance
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
        triangles = geometry.materials.emissive.index_select(0, geometry.material).nonzero()[:, 0]
        power = _triangle_powers(geometry, triangles) * _cone_cosines(scene, geometry, triangles)
        triangles, power = triangles[power > 0.0], power[power > 0.0]
        self._sky = self.environment.power if self.environment else 0.0
        self._triangles = triangles
        self._lamp = torch.full(geometry.material.shape, -1, device=device)
        self._lamp[triangles] = torch.arange(len(triangles), device=device)
        if len(triangles) > 0:
            corners, normals = geometry.corners(triangles), geometry.face_normals(triangles)
            rows = (corners[0], corners[1] - corners[0], corners[2] - corners[0], normals)
            self._rows = torch.cat((*rows, 1.0 / geometry.areas(triangles)[None], geometry.emission_rows(triangles)))  # [17, lamps]
            self._grid = LightGrid(_grid_lamps(scene, geometry, triangles, power), device)

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
        share = self._sky / (self._sky + self._grid.light.index_select(0, cells))
        return share.clamp(MIN_SHARE, 1.0 - MIN_SHARE)

    def _cells(self, points: Tensor) -> Tensor:
        if len(self._triangles) == 0:
            return torch.zeros(points.shape[1], dtype=torch.int32, device=points.device)
        return self._grid.cells(points)

    @cached_property
    def clusters(self) -> LightClusters:
        """All that `sample` may fall on, in clusters."""
        return LightClusters(self._grid if len(self._triangles) else None, self.environment if self._sky > 0.0 else None)

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
            cluster = query.choice.sample((uniforms[0] - BY_CELL) / (1.0 - BY_CELL))
            by_cell = uniforms[0] < BY_CELL
            far = by_cell & (uniforms[0] < BY_CELL * query.environment_share)
            sky = far | (~by_cell & (cluster >= self.clusters.triangles))
            query = replace(query, by_cell=by_cell, cluster=cluster)
        far, near = sky.nonzero()[:, 0], (~sky).nonzero()[:, 0]
        # The one kind is drawn for all points, where there is any, and the rarer one then put in its place.
        kinds = [(near, self._sample_triangles), (far, self._sample_environment)]
        (rare, draw_rare), (_, draw_most) = sorted(kinds, key=lambda kind: len(kind[0]))
        light = draw_most(query, uniforms[1:])
        if len(rare) > 0:
            others = draw_rare(query.select(rare), uniforms[1:].index_select(1, rare))
            for value, other in zip(light, others):
                if value is not None:
                    put(value, rare, other)
        return light

    def _sample_environment(self, query: LightQuery, uniforms: Tensor) -> LightSample:
        element = self.environment.pick(uniforms[[0, 1, 4]])
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
        rows = self._rows.index_select(1, lamp)
        direction, distance, u, v, front, density, radiance = _on_triangle(rows, query.points, uniforms[3:5])
        hit = Hit(self._triangles.index_select(0, lamp), distance, u, v)
        if not self._geometry.materials.plain_emission:
            radiance = radiance * self._geometry.emission_share(hit, -direction)
        transmittance = self._geometry.transmittance(hit, front)
        if transmittance is not None:
            radiance = radiance * transmittance
        if self._geometry.materials.has_sheer:
            radiance = radiance * self._geometry.opacity(hit)
        share = self._cluster_share(query, cluster)
        light = LightSample(direction, distance, radiance, share * self._grid.pdf_within(lamp) * density)
        return light if query.choice is None else light._replace(cluster=cluster, share=share)

    def _cluster_of_triangles(self, query: LightQuery, uniforms: Tensor) -> Tensor:
        """A cluster for each point, from uniform numbers `[N]`, as far as it is not chosen yet."""
        if not query.learnt:
            return self._grid.sample_cluster(query.cells, uniforms)
        index = query.by_cell.nonzero()[:, 0]
        by_cell = self._grid.sample_cluster(query.cells.index_select(0, index), uniforms.index_select(0, index))
        cluster = query.cluster.clamp(max=self._grid.clusters - 1)
        put(cluster, index, by_cell)
        return cluster

    def _cluster_share(self, query: LightQuery, cluster: Tensor) -> Tensor:
        """Probability `[N]` of choosing each of the clusters of triangles."""
        by_cell = (1.0 - query.environment_share) * self._grid.cluster_pdf(query.cells, cluster)
        if not query.learnt:
            return by_cell
        return BY_CELL * by_cell + (1.0 - BY_CELL) * query.choice.pdf(cluster)

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
        within = self._grid.pdf_within(known) * self._rows[12].index_select(0, known)
        return share * within * distance * distance / cosine.abs().clamp(min=1e-12)

    def environment_pdf(self, points: Tensor, directions: Tensor, choice: LightChoice | None = None) -> Tensor:
        """Density `[N]` with which `sample` at points `[3, N]` finds environment directions `[3, N]`."""
        if self._sky == 0.0:
            return torch.zeros_like(directions[0])
        return self._environment_pdf(self.query(points, choice), directions, self.environment.texels(directions))


@kernel
def _on_triangle(rows: Tensor, points: Tensor, uniforms: Tensor) -> tuple[Tensor, ...]:
    """Points, even over triangles, that light `points` `[3, N]`, from uniform numbers `[2, N]`.

    rows: first corners, edges from them, normals, one over the areas, and what `emitted` takes, `[17, N]`. Unit directions
    `[3, N]`; distances, barycentric u and v, 1 where the front is seen, else 0, and densities per unit solid angle, `[N]`
    each; and what their materials emit, `[3, N]`.
    """
    root = uniforms[0].sqrt()
    u, v = root * (1.0 - uniforms[1]), root * uniforms[1]
    offset = rows[0:3] + u * rows[3:6] + v * rows[6:9] - points
    squared = dot(offset, offset).clamp(min=1e-30)
    distance = squared.sqrt()
    direction = offset / distance
    cosine = -dot(rows[9:12], direction)
    front = (cosine > 0.0).to(torch.float32)
    density = rows[12] * squared / cosine.abs().clamp(min=1e-12)
    return direction, distance, u, v, front, density, emitted(rows[13:17], front)


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
        index = (material == number).nonzero()[:, 0]
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
