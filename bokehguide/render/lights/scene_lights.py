"""Lights of a scene: emissive triangles and the environment, with light samples and their densities."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple, Protocol, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry, emitted
from bokehguide.render.lights.base import LightSample
from bokehguide.render.lights.distant import cap_directions, frame_about
from bokehguide.render.lights.environment import EnvironmentLight
from bokehguide.render.lights.light_clusters import LightClusters
from bokehguide.render.lights.voxel_grid import GridEmitters, LightVoxelGrid
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.vector import cross, divisor, dot, luminance, normalize
from bokehguide.runtime.indexing import indices, scatter
from bokehguide.scene.types import Scene

MIN_SHARE = 0.1
"""Least share of light samples for triangles, and for the environment, if a scene has both."""
POWER_GRID = 4
"""Square root of the number of points over which the power of a textured triangle is averaged."""
CONE_DIRECTIONS = 64
"""Number of directions in the cone over which the power of a spotlight is averaged."""
MIN_COSINE = 1e-12
"""Least cosine at emitters, so that densities per unit solid angle stay finite."""
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Golden ratio minus 1, for evenly spread points."""


Density = Callable[[Tensor, Tensor], Tensor]
"""Solid-angle density `[N]` of unit directions `[3, N]`, which lie in texels `[N]` of the map."""


class PointQuery(NamedTuple):
    """N shading points `[3, N]`, their voxel grid cells, int32 `[N]`, and the environment's share of light samples, `[N]`."""

    points: Tensor
    cells: Tensor
    environment_share: Tensor

    def select(self, index: Tensor) -> PointQuery:
        """Query of the points at `index`, int64 `[M]`."""
        return PointQuery(*(values.index_select(-1, index) for values in self))


class _Query(Protocol):
    def select(self, index: Tensor) -> Self: ...


Q = TypeVar("Q", bound=_Query)
S = TypeVar("S", bound=tuple[Tensor, ...])


class Lights:
    """Emitters of a scene: emissive triangles, in clusters of a `LightVoxelGrid`, and the environment, with distant lights.

    Light samplers use the methods of this class. environment: None if the scene has neither a map nor distant lights.
    """

    def __init__(self, scene: Scene, geometry: Geometry):
        self._geometry = geometry
        device = geometry.device
        at_infinity = scene.environment is not None or len(scene.suns) > 0
        self.environment = EnvironmentLight(scene.environment, scene.suns, device) if at_infinity else None
        triangles = indices(geometry.materials.emissive.index_select(0, geometry.material))
        power = _triangle_powers(geometry, triangles) * _cone_cosines(scene, geometry, triangles)
        triangles, power = triangles[power > 0.0], power[power > 0.0]
        self.far_power = self.environment.power if self.environment else 0.0
        self._grid: LightVoxelGrid | None = None
        if len(triangles) > 0:
            grid = self._grid = LightVoxelGrid(_grid_emitters(scene, geometry, triangles, power), device)
            triangles = triangles[torch.from_numpy(grid.order).to(device)]
            within = grid.pdf_within(torch.arange(len(triangles), device=device))
            self._density = within / geometry.areas(triangles)
            corners = geometry.corners(triangles)
            edges = corners[1] - corners[0], corners[2] - corners[0]
            self.rows = torch.cat((corners[0], *edges, geometry.emission_rows(triangles), self._density[None]))  # [14, emitters]
            self.far_share = (self.far_power / (self.far_power + grid.light)).clamp(MIN_SHARE, 1.0 - MIN_SHARE)
        self.triangles = triangles
        self.emitter = torch.full(geometry.material.shape, -1, device=device)
        self.emitter[triangles] = torch.arange(len(triangles), device=device)

    @property
    def grid(self) -> LightVoxelGrid:
        """Voxel grid; call only for a scene with emissive triangles."""
        assert self._grid is not None
        return self._grid

    @property
    def sampled_environment(self) -> EnvironmentLight:
        """Environment; call only for a scene with an environment."""
        assert self.environment is not None
        return self.environment

    @property
    def empty(self) -> bool:
        """Whether no light can be sampled."""
        return self.far_power == 0.0 and len(self.triangles) == 0

    def query(self, points: Tensor) -> PointQuery:
        """Shading points `[3, N]` with their cells."""
        if self._grid is None:
            cells = torch.zeros(points.shape[1], dtype=torch.int32, device=points.device)
            return PointQuery(points, cells, torch.full(cells.shape, float(self.far_power > 0.0), device=points.device))
        cells = self._grid.cells(points)
        if self.far_power == 0.0:
            return PointQuery(points, cells, torch.zeros(cells.shape, device=points.device))
        return PointQuery(points, cells, self.far_share.index_select(0, cells))

    @cached_property
    def clusters(self) -> LightClusters:
        """Clusters of all lights."""
        return LightClusters(self._grid, self.environment if self.far_power > 0.0 else None)

    def draw_by_kind(
        self,
        is_far: Tensor,
        query: Q,
        uniforms: Tensor,
        draw_environment: Callable[[Q, Tensor], S],
        draw_triangles: Callable[[Q, Tensor], S],
    ) -> S:
        """Samples of the environment where `is_far`, bool `[N]`, is true, else of triangles, from uniform numbers `[5, N]`.

        On a CPU, all points first draw the more common kind. The points of the other kind then draw again, and the new samples
        replace the first samples, so that few rows are copied. On a GPU, all points draw both kinds. This is faster than a wait
        for the counts.
        """
        if self.far_power == 0.0:
            return draw_triangles(query, uniforms)
        if len(self.triangles) == 0:
            return draw_environment(query, uniforms)
        if is_far.device.type != "cpu":
            samples = draw_triangles(query, uniforms)
            pairs = zip(draw_environment(query, uniforms), samples)
            return type(samples)(*(torch.where(is_far, far, near) for far, near in pairs))
        rare, draw_rare, draw_common = indices(is_far), draw_environment, draw_triangles
        if 2 * len(rare) > len(is_far):
            rare, draw_rare, draw_common = indices(~is_far), draw_triangles, draw_environment
        light = draw_common(query, uniforms)
        if len(rare) > 0:
            others = draw_rare(query.select(rare), uniforms.index_select(1, rare))
            for value, other in zip(light, others):
                scatter(value, rare, other)
        return light

    def environment_sample(self, element: Tensor, uniforms: Tensor, density: Density) -> LightSample:
        """Samples of elements `[N]` of the environment from uniform numbers `[2, N]`; density: of directions in texels."""
        environment = self.sampled_environment
        direction = environment.directions(element, uniforms)
        pdf = density(direction, environment.texels(direction, element))
        nowhere = torch.full(pdf.shape, -1, dtype=torch.int32, device=pdf.device)
        return LightSample(direction, torch.full_like(pdf, MISS_DISTANCE), environment.radiance(direction), pdf, nowhere)

    def triangle_sample(self, points: Tensor, cluster: Tensor, share: Tensor, uniforms: Tensor) -> LightSample:
        """Samples for points `[3, N]` on triangles of clusters `[N]`, from uniform numbers `[4, N]`.

        share: probability with which the clusters were chosen, `[N]`.
        """
        emitter = self.grid.sample_within(cluster, uniforms[0:2])
        rows = self.rows.index_select(1, emitter)
        direction, distance, u, v, front, pdf, radiance = _on_triangle(rows, points, uniforms[2:4], share)
        materials, triangle = self._geometry.materials, self.triangles.index_select(0, emitter)
        if materials.absorbs or materials.has_translucent or not materials.plain_emission:
            radiance = self._dimmed(radiance, Hit(triangle, distance, u, v), direction, front)
        return LightSample(direction, distance, radiance, pdf, triangle.int())

    def _dimmed(self, radiance: Tensor, hit: Hit, direction: Tensor, front: Tensor) -> Tensor:
        """Radiance `[3, N]` that arrives from emitters at `hit` in unit directions `direction`, without occlusion.

        Cones, clearcoats, absorbing solids and opacity reduce the `radiance` of the emitters.
        """
        if not self._geometry.materials.plain_emission:
            radiance = radiance * self._geometry.emission_share(hit, -direction)
        transmittance = self._geometry.transmittance(hit, front)
        if transmittance is not None:
            radiance = radiance * transmittance
        return radiance * self._geometry.opacity(hit) if self._geometry.materials.has_translucent else radiance

    def triangle_pdf(self, triangle: Tensor, distance: Tensor, cosine: Tensor, share: Callable[[Tensor], Tensor]) -> Tensor:
        """Density `[N]` of samples on `triangle`, 0 for triangles without emission.

        distance, cosine: of the point on the triangle, seen from the shading point, `[N]`. share: probability of clusters, `[N]`.
        """
        if len(self.triangles) == 0:
            return torch.zeros_like(distance)
        emitter = self.emitter.index_select(0, triangle)
        known = emitter.clamp(min=0)
        chosen = share(self.grid.cluster(known)) * (emitter >= 0)
        return chosen * self._density.index_select(0, known) * distance * distance / divisor(cosine.abs(), MIN_COSINE)

    def environment_pdf(self, directions: Tensor, density: Density) -> Tensor:
        """Density `[N]` of samples of unit directions `[3, N]` of the environment; density: of directions in texels."""
        if self.far_power == 0.0:
            return torch.zeros_like(directions[0])
        return density(directions, self.sampled_environment.texels(directions))


def _on_triangle(rows: Tensor, points: Tensor, uniforms: Tensor, share: Tensor) -> tuple[Tensor, ...]:
    """Samples, uniform over triangles, seen from `points` `[3, N]`, from uniform numbers `[2, N]`.

    rows: first corners, edges from the first corners, rows for `emitted`, and densities per unit area within the triangle's
    cluster, `[14, N]`. share: probability of the cluster, `[N]`. Returns unit directions `[3, N]`; distances, barycentric u and
    v, 1 for the front, else 0, and densities per unit solid angle, `[N]` each; and emission `[3, N]`.
    """
    root = uniforms[0].sqrt()
    u, v = root * (1.0 - uniforms[1]), root * uniforms[1]
    first, second = rows[3:6], rows[6:9]
    offset = rows[0:3] + u * first + v * second - points
    squared = divisor(dot(offset, offset))
    distance = squared.sqrt()
    direction = offset / distance
    cosine = -dot(normalize(cross(first, second)), direction)
    front = (cosine > 0.0).to(torch.float32)
    pdf = share * rows[13] * squared / divisor(cosine.abs(), MIN_COSINE)
    return direction, distance, u, v, front, pdf, emitted(rows[9:13], front)


def _grid_emitters(scene: Scene, geometry: Geometry, triangles: Tensor, power: Tensor) -> GridEmitters:
    """Emissive triangles for the voxel grid."""
    material = geometry.material.index_select(0, triangles).cpu().numpy()
    cones = [m.emission_cone for m in scene.materials]
    return GridEmitters(
        center=geometry.corners(triangles).mean(0).T.cpu().numpy(),
        normal=geometry.face_normals(triangles).T.cpu().numpy(),
        power=power.cpu().numpy(),
        double_sided=(geometry.is_double_sided(triangles) > 0.0).cpu().numpy(),
        axis=np.array([cone.axis if cone else (0.0, 0.0, 0.0) for cone in cones])[material],
        outer=np.array([math.radians(cone.outer) if cone else math.pi for cone in cones])[material],
    )


def _cone_cosines(scene: Scene, geometry: Geometry, triangles: Tensor) -> Tensor:
    """Mean cosine `[K]` of emission directions for triangles with emission cones, 1 for all others.

    The side of a spherical spotlight that faces away from the cone therefore has no power.
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
    """Area times mean emitted luminance of each triangle, summed over both faces of double-sided triangles."""
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
