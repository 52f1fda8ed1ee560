"""Light sampling at primary hits: a table of probabilities chooses clusters of lights, and resampling keeps one sample."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render import dimensions, mis
from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.lights.base import ClusterRecord, DirectLight, LightSample
from bokehguide.render.lights.clusters import ClusterTable
from bokehguide.render.lights.power_sampler import PowerLightSampler, voxel_share
from bokehguide.render.lights.scene_lights import PointQuery
from bokehguide.render.mis import BsdfWeights
from bokehguide.render.random import PixelRandom
from bokehguide.render.surface import Surface
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import divisor, luminance
from bokehguide.runtime.indexing import indices, scatter

VOXEL_SHARE = 0.125
"""Share of light samples for which the voxel grid chooses the cluster. Every light then has a positive density."""
MAX_UNIFORM = 1.0 - 2.0**-24
"""Largest float32 below 1."""


class ClusterSample(NamedTuple):
    """A `LightSample` with its cluster, int32 `[N]`, and the probability of choosing the cluster, `share`, `[N]`."""

    direction: Tensor
    distance: Tensor
    radiance: Tensor
    pdf: Tensor
    triangle: Tensor
    cluster: Tensor
    share: Tensor


class _Candidate(NamedTuple):
    """N candidates of resampling. value: contribution, `[3, N]`. target: luminance of the contribution by the power heuristic
    alone, times expected visibility, `[N]`.

    share, cluster: see `ClusterSample`; 0 and -1 for BSDF samples, which the record of clusters ignores. triangle: see
    `LightSample`. broad: see `ClusterRecord`.
    """

    direction: Tensor
    distance: Tensor
    value: Tensor
    share: Tensor
    target: Tensor
    cluster: Tensor
    bsdf_pdf: Tensor
    triangle: Tensor
    broad: Tensor


class Counts(NamedTuple):
    """Numbers of light samples and of BSDF samples at a primary hit, from which resampling keeps one.

    Without a sampled map, light samples take the place of the BSDF samples.
    """

    lights: int
    bsdf: int


class ResampledLights:
    """Base class of distributions from which resampling keeps one sample.

    row: row of each point in the table of probabilities that learns from the samples, int32 `[N]`. factor: of the broad part of
    the MIS weights of light samples (`BsdfWeights`), `[N]` or one number.
    """

    first_step: int

    def __init__(self, power: PowerLightSampler, row: Tensor, counts: Counts, factor: Tensor | float):
        self._power, self._row, self._counts, self._factor = power, row, counts, factor
        self._light_count, self._bsdf_count = sample_counts(power, counts)

    def draw(self, query: PointQuery, uniforms: Tensor) -> ClusterSample:
        """One light sample for each point of the query from uniform numbers `[6, N]`."""
        raise NotImplementedError

    def expected_visibility(self, cluster: Tensor) -> Tensor:
        """Expected visible share of the light of each cluster `[N]`."""
        raise NotImplementedError

    def triangle_pdf(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor) -> Tensor:
        """See `LightDistribution`."""
        raise NotImplementedError

    def environment_pdf(self, points: Tensor, directions: Tensor) -> Tensor:
        """See `LightDistribution`."""
        raise NotImplementedError

    def triangle_weights(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor, pdf: Tensor) -> BsdfWeights:
        """See `LightDistribution`."""
        light_pdf = self._light_count * self.triangle_pdf(points, triangle, distance, cosine)
        return BsdfWeights.with_factor(pdf, light_pdf, self._factor)

    def environment_weights(self, points: Tensor, directions: Tensor, pdf: Tensor) -> BsdfWeights:
        """See `LightDistribution`."""
        light_pdf = self._light_count * self.environment_pdf(points, directions) + self._bsdf_count * pdf
        return BsdfWeights.with_factor(pdf, light_pdf, self._factor)

    def sample(self, surface: Surface, scattering: Scattering, uniforms: Tensor, random: PixelRandom) -> DirectLight:
        """Resampled importance sampling (Talbot et al. 2005): keeps a candidate in proportion to its target.

        Only the kept candidate needs a shadow ray. All candidates together are one technique, whose density is the sum of theirs
        (balance heuristic), because resampling draws directions with a large contribution almost as often as all of them
        together. BSDF candidates draw directions of the map, as Bitterli et al. 2020 do. The other technique is the BSDF sample
        that continues the path. The choices of cluster by the light candidates are stratified.
        """
        query, first = self._power.lights.query(surface.position), dimensions.vertex(1)
        kept = self._light_candidate(query, scattering, uniforms, 0)
        total = kept.target
        for number in range(1, self._light_count + self._bsdf_count):
            if number < self._light_count:
                light = random.stratified(first + dimensions.LIGHT, dimensions.LIGHT_COUNT, self.first_step, number)
                other = self._light_candidate(query, scattering, light, number)
            else:
                scatter, further = (first + dimensions.SCATTER, dimensions.SCATTER_COUNT), number - self._light_count + 1
                bsdf = dimensions.bsdf_numbers(random.stratified(*scatter, self.first_step, further))
                other = self._bsdf_candidate(surface.position, scattering, bsdf)
            total = total + other.target
            changes = random.uniform(dimensions.choice(number), 1)[0] * total < other.target
            kept = _Candidate(*(torch.where(changes, one, two) for one, two in zip(other, kept)))
        scale = total / (self._light_count * divisor(kept.target))
        contribution_rms = luminance(kept.value) * (kept.share * scale).sqrt()
        clusters = ClusterRecord(self._row, kept.cluster, contribution_rms, kept.broad)
        return DirectLight(kept.direction, kept.distance, kept.value * scale, kept.bsdf_pdf, kept.triangle, clusters)

    def _light_candidate(self, query: PointQuery, scattering: Scattering, uniforms: Tensor, number: int) -> _Candidate:
        """Candidates of this number from uniform numbers `[6, N]`, the first of which chooses the cluster."""
        stratum = ((uniforms[:1] + number) / self._light_count).clamp(max=MAX_UNIFORM)
        light = self.draw(query, torch.cat((stratum, uniforms[1:])))
        value, bsdf_pdf = scattering.evaluate(light.direction)
        found = torch.where(light.distance >= MISS_DISTANCE, self._bsdf_count * bsdf_pdf, 0.0)
        pdf = self._light_count * light.pdf + found
        value, contribution, broad = self._weighed(value * light.radiance / divisor(pdf), pdf, bsdf_pdf)
        target = luminance(contribution) * self.expected_visibility(light.cluster)
        chosen = light.share, target, light.cluster, bsdf_pdf, light.triangle, broad
        return _Candidate(light.direction, light.distance, value, *chosen)

    def _bsdf_candidate(self, points: Tensor, scattering: Scattering, uniforms: Tensor) -> _Candidate:
        """Candidates from uniform numbers `[3, N]`."""
        direction, weight, pdf = scattering.sample(uniforms)
        environment, clusters = self._power.lights.sampled_environment, self._power.lights.clusters
        cluster = clusters.cluster(environment.texels(direction))
        together = self._light_count * self.environment_pdf(points, direction) + self._bsdf_count * pdf
        light = weight * environment.radiance(direction) * (pdf / divisor(together))
        value, contribution, broad = self._weighed(light, together, pdf)
        target, far = luminance(contribution) * self.expected_visibility(cluster), torch.full_like(pdf, MISS_DISTANCE)
        none = torch.full_like(cluster, -1)
        return _Candidate(direction, far, value, torch.zeros_like(pdf), target, none, pdf, none, broad)

    def _weighed(self, light: Tensor, pdf: Tensor, bsdf_pdf: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Contributions `[3, N]` of reflected light over the density `pdf` of all candidates; the same by the power heuristic
        alone; and `ClusterRecord.broad`."""
        contribution = light * (mis.power_heuristic(pdf, bsdf_pdf) * self._light_count)
        broad = mis.broad_share(pdf, bsdf_pdf)
        factor = 1.0 - (1.0 - self._factor) * broad
        return contribution * factor, contribution, broad / factor


def sample_counts(power: PowerLightSampler, counts: Counts) -> Counts:
    """Numbers of samples at primary hits: see `Counts`."""
    return counts if power.lights.clusters.map else Counts(sum(counts), 0)


class VoxelLights(ResampledLights):
    """Distribution of light samples in the first epoch: the voxel grid chooses the clusters."""

    first_step = 1

    def __init__(self, power: PowerLightSampler, row: Tensor, counts: Counts):
        super().__init__(power, row, counts, 1.0)

    def select(self, index: Tensor) -> VoxelLights:
        """See `LightDistribution`."""
        return VoxelLights(self._power, self._row.index_select(0, index), self._counts)

    def expected_visibility(self, cluster: Tensor) -> Tensor:
        """1 for each cluster `[N]`: the visibility is unknown."""
        return torch.ones(cluster.shape, device=cluster.device)

    def draw(self, query: PointQuery, uniforms: Tensor) -> ClusterSample:
        """See `ResampledLights`."""
        is_far = uniforms[0] < query.environment_share
        return self._power.lights.draw_by_kind(is_far, query, uniforms[1:], self._draw_environment, self._draw_triangles)

    def _draw_environment(self, query: PointQuery, uniforms: Tensor) -> ClusterSample:
        element = self._power.environment_element(uniforms)
        light = self._power.environment_sample(query, element, uniforms[2:4])
        return _environment_cluster(self._power, element, light)

    def _draw_triangles(self, query: PointQuery, uniforms: Tensor) -> ClusterSample:
        cluster = self._power.sample_cluster(query, uniforms[0])
        share = self._power.share(query, cluster)
        return ClusterSample(*self._power.lights.triangle_sample(query.points, cluster, share, uniforms[1:]), cluster, share)

    def triangle_pdf(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor) -> Tensor:
        """See `LightDistribution`."""
        return self._power.triangle_pdf(points, triangle, distance, cosine)

    def environment_pdf(self, points: Tensor, directions: Tensor) -> Tensor:
        """See `LightDistribution`."""
        return self._power.environment_pdf(points, directions)


class ClusterTables(NamedTuple):
    """Probabilities of C clusters in each of R rows. The probabilities have not changed since the step `first_step`.

    visibility: expected visible share of each cluster's light, positive, `[R, C]`. factor: see `ResampledLights`, `[R]`.
    """

    table: ClusterTable
    visibility: Tensor
    factor: Tensor
    first_step: int


class _MixtureQuery(NamedTuple):
    """A `PointQuery` with the row of each point in the table, int32 `[N]`.

    by_voxel: whether the voxel grid chooses the cluster, bool `[N]`. cluster: choice of the table elsewhere, int32 `[N]`.
    """

    points: Tensor
    cells: Tensor
    environment_share: Tensor
    row: Tensor
    by_voxel: Tensor
    cluster: Tensor

    def select(self, index: Tensor) -> _MixtureQuery:
        return _MixtureQuery(*(values.index_select(-1, index) for values in self))


class MixtureLights(ResampledLights):
    """Mixture of two choices of clusters: by a table, and by the voxel grid with the weight VOXEL_SHARE."""

    def __init__(self, power: PowerLightSampler, row: Tensor, tables: ClusterTables, counts: Counts):
        super().__init__(power, row, counts, tables.factor.index_select(0, row))
        self._tables, self.first_step = tables, tables.first_step

    def select(self, index: Tensor) -> MixtureLights:
        """See `LightDistribution`."""
        return MixtureLights(self._power, self._row.index_select(0, index), self._tables, self._counts)

    def expected_visibility(self, cluster: Tensor) -> Tensor:
        """See `ResampledLights`."""
        visibility = self._tables.visibility
        return visibility.view(-1).index_select(0, self._row * visibility.shape[1] + cluster)

    def probability(self, cluster: Tensor, row: Tensor) -> Tensor:
        """Probability with which the table chooses each cluster `[N]` in each row `[N]`."""
        return self._tables.table.pdf(row, cluster)

    def draw(self, query: PointQuery, uniforms: Tensor) -> ClusterSample:
        """See `ResampledLights`."""
        tables = self._tables
        cluster = tables.table.sample(self._row, (uniforms[0] - VOXEL_SHARE) / (1.0 - VOXEL_SHARE))
        by_voxel = uniforms[0] < VOXEL_SHARE
        by_table = cluster >= self._power.lights.clusters.triangles
        is_far = torch.where(by_voxel, uniforms[0] < VOXEL_SHARE * query.environment_share, by_table)
        mixture = _MixtureQuery(*query, self._row, by_voxel, cluster)
        return self._power.lights.draw_by_kind(is_far, mixture, uniforms[1:], self._draw_environment, self._draw_triangles)

    def _draw_environment(self, query: _MixtureQuery, uniforms: Tensor) -> ClusterSample:
        clusters = self._power.lights.clusters
        element = self._power.environment_element(uniforms)
        by_table = clusters.sample_element(query.cluster.clamp(min=clusters.triangles), uniforms[0:2])
        element = torch.where(query.by_voxel, element, by_table)
        density = partial(self._environment_density, query.environment_share, query.row)
        light = self._power.lights.environment_sample(element, uniforms[2:4], density)
        return _environment_cluster(self._power, element, light)

    def _environment_density(self, environment_share: Tensor, row: Tensor, directions: Tensor, texel: Tensor) -> Tensor:
        lights = self._power.lights
        by_voxel = environment_share * lights.sampled_environment.pdf(directions, texel)
        by_table = lights.clusters.environment_pdf(partial(self.probability, row=row), directions, texel)
        return VOXEL_SHARE * by_voxel + (1.0 - VOXEL_SHARE) * by_table

    def _draw_triangles(self, query: _MixtureQuery, uniforms: Tensor) -> ClusterSample:
        cluster = self._triangle_cluster(query, uniforms[0])
        share = self._share(query.cells, query.environment_share, query.row, cluster)
        return ClusterSample(*self._power.lights.triangle_sample(query.points, cluster, share, uniforms[1:]), cluster, share)

    def _triangle_cluster(self, query: _MixtureQuery, uniforms: Tensor) -> Tensor:
        """Clusters of triangles `[N]`: from the table, or by the voxel grid from uniform numbers `[N]`."""
        grid = self._power.lights.grid
        cluster = query.cluster.clamp(max=grid.clusters - 1)
        if query.by_voxel.device.type != "cpu":
            return torch.where(query.by_voxel, grid.sample_cluster(query.cells, uniforms), cluster)
        index = indices(query.by_voxel)
        scatter(cluster, index, grid.sample_cluster(query.cells.index_select(0, index), uniforms.index_select(0, index)))
        return cluster

    def _share(self, cells: Tensor, environment_share: Tensor, row: Tensor, cluster: Tensor) -> Tensor:
        """Probability `[N]` of choosing each of the clusters `[N]` of triangles."""
        share = voxel_share(self._power.lights.grid.table, cells, environment_share, cluster)
        return VOXEL_SHARE * share + (1.0 - VOXEL_SHARE) * self.probability(cluster, row)

    def triangle_pdf(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor) -> Tensor:
        """See `LightDistribution`."""

        def share(cluster: Tensor) -> Tensor:
            query = self._power.lights.query(points)
            return self._share(query.cells, query.environment_share, self._row, cluster)

        return self._power.lights.triangle_pdf(triangle, distance, cosine, share)

    def environment_pdf(self, points: Tensor, directions: Tensor) -> Tensor:
        """See `LightDistribution`."""

        def density(directions: Tensor, texel: Tensor) -> Tensor:
            return self._environment_density(self._power.lights.query(points).environment_share, self._row, directions, texel)

        return self._power.lights.environment_pdf(directions, density)


def _environment_cluster(power: PowerLightSampler, element: Tensor, light: LightSample) -> ClusterSample:
    """Samples of the environment's elements `[N]` with their clusters."""
    clusters = power.lights.clusters
    return ClusterSample(*light, clusters.cluster(element), light.pdf / clusters.pdf_within(element))
