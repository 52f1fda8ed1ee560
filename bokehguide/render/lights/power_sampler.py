"""Light sampling by power: the choice between the environment and clusters of triangles depends on the cell of a voxel grid."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from bokehguide.render import mis
from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.lights.base import DirectLight, LightSample, LightSampler
from bokehguide.render.lights.clusters import ClusterTable
from bokehguide.render.lights.scene_lights import Lights, PointQuery
from bokehguide.render.mis import BsdfWeights
from bokehguide.render.random import PixelRandom
from bokehguide.render.surface import Surface


class PowerLightSampler(LightSampler):
    """Samples lights by the unshadowed light that they may send into a cell of the voxel grid: the path tracer's default.

    The sampler is also the distribution that `at` returns. The distribution depends on the cell of a point, and never changes.
    """

    first_step = 1
    in_core = True

    def __init__(self, lights: Lights):
        self.lights = lights

    def at(self, points: Tensor) -> PowerLightSampler:
        """See `LightSampler`."""
        return self

    def select(self, index: Tensor) -> PowerLightSampler:
        """See `LightDistribution`."""
        return self

    def sample(self, surface: Surface, scattering: Scattering, uniforms: Tensor, random: PixelRandom) -> DirectLight:
        """See `LightDistribution`."""
        light = self.draw(self.lights.query(surface.position), uniforms)
        scattered = scattering.evaluate(light.direction)
        value = mis.light_contribution(light.radiance, light.pdf, *scattered)
        return DirectLight(light.direction, light.distance, value, scattered[1], light.triangle)

    def draw(self, query: PointQuery, uniforms: Tensor) -> LightSample:
        """One light sample for each point of the query from uniform numbers `[6, N]`."""
        is_far = uniforms[0] < query.environment_share
        return self.lights.draw_by_kind(is_far, query, uniforms[1:], self._draw_environment, self._draw_triangles)

    def _draw_environment(self, query: PointQuery, uniforms: Tensor) -> LightSample:
        return self.environment_sample(query, self.environment_element(uniforms), uniforms[2:4])

    def _draw_triangles(self, query: PointQuery, uniforms: Tensor) -> LightSample:
        cluster = self.sample_cluster(query, uniforms[0])
        return self.lights.triangle_sample(query.points, cluster, self.share(query, cluster), uniforms[1:])

    def environment_element(self, uniforms: Tensor) -> Tensor:
        """Elements `[N]` of the environment, drawn in proportion to their power from uniform numbers `[5, N]`."""
        return self.lights.sampled_environment.sample_element(torch.stack((uniforms[0], uniforms[1], uniforms[4])))

    def environment_sample(self, query: PointQuery, element: Tensor, uniforms: Tensor) -> LightSample:
        """Samples of elements `[N]` of the environment from uniform numbers `[2, N]`."""
        return self.lights.environment_sample(element, uniforms, partial(self._environment_density, query))

    def _environment_density(self, query: PointQuery, directions: Tensor, texel: Tensor) -> Tensor:
        return query.environment_share * self.lights.sampled_environment.pdf(directions, texel)

    def sample_cluster(self, query: PointQuery, uniforms: Tensor) -> Tensor:
        """Clusters `[N]` of triangles from uniform numbers `[N]`."""
        return self.lights.grid.sample_cluster(query.cells, uniforms)

    def share(self, query: PointQuery, cluster: Tensor) -> Tensor:
        """Probability `[N]` of choosing each of the clusters `[N]` of triangles."""
        return voxel_share(self.lights.grid.table, query.cells, query.environment_share, cluster)

    def triangle_pdf(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor) -> Tensor:
        """See `LightDistribution`."""
        return self.lights.triangle_pdf(
            triangle, distance, cosine, lambda cluster: self.share(self.lights.query(points), cluster)
        )

    def environment_pdf(self, points: Tensor, directions: Tensor) -> Tensor:
        """See `LightDistribution`."""
        return self.lights.environment_pdf(directions, lambda *at: self._environment_density(self.lights.query(points), *at))

    def triangle_weights(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor, pdf: Tensor) -> BsdfWeights:
        """See `LightDistribution`."""
        return BsdfWeights(mis.power_heuristic(pdf, self.triangle_pdf(points, triangle, distance, cosine)))

    def environment_weights(self, points: Tensor, directions: Tensor, pdf: Tensor) -> BsdfWeights:
        """See `LightDistribution`."""
        return BsdfWeights(mis.power_heuristic(pdf, self.environment_pdf(points, directions)))


def voxel_share(table: ClusterTable, cells: Tensor, environment_share: Tensor, cluster: Tensor) -> Tensor:
    """Probability `[N]` with which cells `[N]` of the voxel grid choose clusters `[N]` of triangles."""
    return (1.0 - environment_share) * table.pdf(cells, cluster)
