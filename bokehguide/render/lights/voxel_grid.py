"""A coarse voxel grid over the scene, in which each cell has probabilities of clusters of emissive triangles.

With many emitters, a choice by power alone is noisy: a dim emitter close to a surface may contribute most of the surface's light.
Clusters contain triangles of similar position and normal. The probability of a cluster in a cell follows from the unshadowed
light that the cluster sends into the cell.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.lights.alias_table import AliasTable
from bokehguide.render.lights.clusters import ClusterTable, build_clusters

RESOLUTION = 24
"""Cells along the longest side of the grid."""
DEFENSIVE = 0.1
"""Share of each cell's probabilities that follows power alone, so that every emitter has a positive probability."""


class _Layout(NamedTuple):
    """A grid of cubic cells: lower corner `[3]`, cell size in metres, shape `[3]`."""

    low: np.ndarray
    cell: float
    shape: np.ndarray

    def middles(self) -> np.ndarray:
        """Centres of all cells, `[cells, 3]`."""
        return self.low + (self._indices() + 0.5) * self.cell

    def is_outer(self) -> np.ndarray:
        """Whether a cell lies at a side of the grid, and therefore also represents the space beyond, bool `[cells]`."""
        index = self._indices()
        return ((index == 0) | (index == self.shape - 1)).any(axis=1)

    def _indices(self) -> np.ndarray:
        return np.indices(tuple(self.shape.tolist())).reshape(3, -1).T


class GridEmitters(NamedTuple):
    """K emissive triangles.

    center, normal: `[K, 3]`. power: area times luminance, positive, `[K]`. double_sided: bool `[K]`. axis: axis of the emission
    cone, `[K, 3]`. outer: outer angle of the cone, radians, π without a cone, `[K]`.
    """

    center: np.ndarray
    normal: np.ndarray
    power: np.ndarray
    double_sided: np.ndarray
    axis: np.ndarray
    outer: np.ndarray


class _Clusters(NamedTuple):
    """Properties of C clusters.

    total: power, `[C]`. place, facing, axis: means of centres, normals and cone axes, weighted by power, `[C, 3]`. both: mean of
    double-sidedness, weighted by power, `[C]`. extent: largest distance of a centre from `place`, `[C]`. outer: widest cone,
    radians, `[C]`.
    """

    total: np.ndarray
    place: np.ndarray
    facing: np.ndarray
    axis: np.ndarray
    both: np.ndarray
    extent: np.ndarray
    outer: np.ndarray


class LightVoxelGrid:
    """A choice among K triangles that depends on the shading point; the measure is counting.

    Triangles have new numbers, cluster by cluster. order: index of each triangle among the given triangles, int64 `[K]`.
    clusters: number of clusters. table: probabilities of clusters in each cell. light: unshadowed light of all clusters in each
    cell, luminance times solid angle, `[cells]`.
    """

    def __init__(self, emitters: GridEmitters, device: torch.device):
        features = np.concatenate((emitters.center, emitters.normal * _direction_scale(emitters.center)), axis=1)
        cluster, self.clusters = build_clusters(features, emitters.power)
        self.order = np.argsort(cluster, kind="stable")
        emitters = GridEmitters(*(field[self.order] for field in emitters))
        cluster = cluster[self.order]
        self.within = AliasTable(emitters.power, device, np.searchsorted(cluster, np.arange(self.clusters + 1)))
        self.cluster_of = torch.from_numpy(cluster.astype(np.int32)).to(device)
        layout = _layout(emitters.center)
        low, cell, (x, y, z) = layout
        self.box = [torch.tensor(values, device=device) for values in (low, [1.0 / cell], [x - 1, y - 1, z - 1], [y * z, z, 1])]
        self.box = [values.reshape(-1, 1).float() for values in self.box[:3]] + [self.box[3][:, None].int()]
        """Lower corner of the grid, cells per metre, last cell, and increment of the cell's number, `[3, 1]` or `[1, 1]`."""
        clusters = _cluster_properties(emitters, cluster, self.clusters)
        light = _cell_light(layout, clusters)
        self.light = torch.from_numpy(light.sum(axis=1).astype(np.float32)).to(device)
        self.table = ClusterTable(torch.from_numpy(_defensive(light, clusters.total)).to(device))

    def cells(self, points: Tensor) -> Tensor:
        """Cell `[N]` of each point `[3, N]`; points outside belong to the nearest cell."""
        low, scale, last, step = self.box
        x, y, z = torch.minimum(((points - low) * scale).clamp(min=0.0), last).int() * step
        return x + y + z

    def sample_cluster(self, cells: Tensor, uniforms: Tensor) -> Tensor:
        """Clusters `[N]` for points in `cells` `[N]`, from uniform numbers `[N]`."""
        return self.table.sample(cells, uniforms)

    def sample_within(self, cluster: Tensor, uniforms: Tensor) -> Tensor:
        """Triangles `[N]` of clusters `[N]`, drawn in proportion to their power from uniform numbers `[2, N]`."""
        return self.within.sample(uniforms, cluster)

    def cluster(self, triangle: Tensor) -> Tensor:
        """Cluster `[N]` of each triangle."""
        return self.cluster_of.index_select(0, triangle)

    def pdf_within(self, triangle: Tensor) -> Tensor:
        """Probability `[N]` of choosing each triangle in its cluster."""
        return self.within.pdf(triangle)


def _direction_scale(centers: np.ndarray) -> float:
    """Length that weights normals against positions, so that the bisection splits small emitters last."""
    return 0.02 * float(np.linalg.norm(np.ptp(centers, axis=0)))


def _layout(centers: np.ndarray) -> _Layout:
    """A grid around the emitters."""
    low, high = centers.min(axis=0).astype(np.float64), centers.max(axis=0).astype(np.float64)
    margin = 0.25 * float(np.linalg.norm(high - low)) + 1e-3 * float(np.abs(high).max()) or 1e-6
    low, high = low - margin, high + margin
    cell = float((high - low).max()) / RESOLUTION
    return _Layout(low, cell, np.maximum(np.ceil((high - low) / cell), 1).astype(np.int64))


def _cluster_properties(emitters: GridEmitters, cluster: np.ndarray, count: int) -> _Clusters:
    """Properties of the clusters of emitters."""
    total = np.bincount(cluster, emitters.power, count)
    fields = np.concatenate((emitters.center, emitters.normal, emitters.axis, emitters.double_sided[:, None]), axis=1)
    means = np.stack([np.bincount(cluster, emitters.power * field, count) for field in fields.T], axis=1) / total[:, None]
    extent, outer = np.zeros(count), np.zeros(count)
    np.maximum.at(extent, cluster, np.linalg.norm(emitters.center - means[cluster, 0:3], axis=1))
    np.maximum.at(outer, cluster, emitters.outer)
    return _Clusters(total, means[:, 0:3], means[:, 3:6], means[:, 6:9], means[:, 9], extent, outer)


def _cell_light(layout: _Layout, clusters: _Clusters) -> np.ndarray:
    """Unshadowed light of each cluster in each cell, `[cells, clusters]`."""
    offset = layout.middles()[:, None] - clusters.place[None]
    squared = np.maximum(np.einsum("ckd,ckd->ck", offset, offset), 0.25 * layout.cell**2)
    distance = np.sqrt(squared)
    cosine = np.einsum("ckd,kd->ck", offset, clusters.facing) / distance
    width = 1.0 - np.linalg.norm(clusters.facing, axis=1) + 0.5 * layout.cell / distance  # spread of normals and cell
    light = clusters.total * np.clip(cosine + width + 2.0 * clusters.both, 0.0, 1.0) / squared
    spots = np.flatnonzero(clusters.outer < np.pi)
    lit = _in_cones(layout.cell, offset[:, spots], distance[:, spots], _Clusters(*(field[spots] for field in clusters)))
    light[:, spots] *= lit | layout.is_outer()[:, None]
    return light


def _in_cones(cell: float, offset: np.ndarray, distance: np.ndarray, spots: _Clusters) -> np.ndarray:
    """Whether parts of cells at `offset` `[cells, spots, 3]` may lie in cones of clusters, bool `[cells, spots]`."""
    straight = np.linalg.norm(spots.axis, axis=1)
    cosine = np.einsum("ckd,kd->ck", offset, spots.axis) / (distance * np.maximum(straight, 1e-12))
    spread = 2.0 * np.arccos(np.clip(straight, 0.0, 1.0))  # of the axes
    reach = (0.5 * math.sqrt(3.0) * cell + spots.extent) / distance
    size = np.where(reach < 1.0, np.arcsin(np.minimum(reach, 1.0)), np.pi)
    return np.arccos(np.clip(cosine, -1.0, 1.0)) <= spots.outer + spread + size


def _defensive(weights: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Probability of each cluster in each cell: a mixture of its share of the light and of its share of the power."""
    by_power = power / power.sum()
    sums = weights.sum(axis=1, keepdims=True)
    by_light = np.divide(weights, sums, out=np.broadcast_to(by_power, weights.shape).copy(), where=sums > 0.0)
    return (1.0 - DEFENSIVE) * by_light + DEFENSIVE * by_power
