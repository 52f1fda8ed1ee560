"""Which lamp to sample from where: a coarse grid over the scene with a choice of its own in every cell.

With many lamps, power alone is a poor guide: a dim lamp beside a wall outshines all the
others there. Emissive triangles are gathered into clusters of like place and direction;
each cell knows how much light each cluster could send to it, unshadowed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.alias import AliasTable
from bokehguide.render.clusters import ClusterTable, gather, sampled
from bokehguide.render.kernels import kernel

RESOLUTION = 24
"""Cells along the grid's longest side."""
DEFENSIVE = 0.1
"""Share of every cell's choice that goes by power alone, so that no lamp is ever left out."""


class _Layout(NamedTuple):
    """A grid of cubic cells: lower corner `[3]`, cell size in metres, shape `[3]`."""

    low: np.ndarray
    cell: float
    shape: np.ndarray

    def middles(self) -> np.ndarray:
        """Centres of all cells, `[cells, 3]`."""
        return self.low + (self._indices() + 0.5) * self.cell

    def is_outer(self) -> np.ndarray:
        """Which cells lie at the grid's sides, and so stand for all that lies beyond, bool `[cells]`."""
        index = self._indices()
        return ((index == 0) | (index == self.shape - 1)).any(axis=1)

    def _indices(self) -> np.ndarray:
        return np.indices(self.shape).reshape(3, -1).T


class GridLamps(NamedTuple):
    """K emissive triangles.

    center, normal: `[K, 3]`; power: `[K]`, area times luminance, positive; double_sided:
    bool `[K]`. axis `[K, 3]` and outer `[K]`, radians, of the cones they emit into; those
    without have π.
    """

    center: np.ndarray
    normal: np.ndarray
    power: np.ndarray
    double_sided: np.ndarray
    axis: np.ndarray
    outer: np.ndarray


class _Clusters(NamedTuple):
    """Lamps of C clusters together.

    total: power `[C]`; place, facing, axis `[C, 3]` and both `[C]`: means of centres,
    normals, cone axes and double-sidedness, by power. extent: how far centres lie from
    `place`; outer: the widest cone, radians, `[C]`.
    """

    total: np.ndarray
    place: np.ndarray
    facing: np.ndarray
    axis: np.ndarray
    both: np.ndarray
    extent: np.ndarray
    outer: np.ndarray


class LightGrid:
    """A choice among K triangles that depends on the shaded point; the measure is counting.

    Triangles are numbered cluster by cluster: order says which of those given each is, int64 `[K]`. light: `[cells]`, how
    much each cell may get of it, as luminance integrated over solid angle. clusters: how many. table: of them by cell.
    """

    def __init__(self, lamps: GridLamps, device: torch.device):
        features = np.concatenate((lamps.center, lamps.normal * _direction_scale(lamps.center)), axis=1)
        cluster, self.clusters = gather(features, lamps.power)
        self.order = np.argsort(cluster, kind="stable")
        lamps = GridLamps(*(field[self.order] for field in lamps))
        cluster = cluster[self.order]
        self._within = AliasTable(lamps.power, device, np.searchsorted(cluster, np.arange(self.clusters + 1)))
        self._cluster = torch.from_numpy(cluster.astype(np.int32)).to(device)
        layout = _layout(lamps.center)
        low, cell, (x, y, z) = layout
        self._box = [torch.tensor(values, device=device) for values in (low, [1.0 / cell], [x - 1, y - 1, z - 1], [y * z, z, 1])]
        self._box = [values.reshape(-1, 1).float() for values in self._box[:3]] + [self._box[3][:, None].int()]
        clusters = _gathered(lamps, cluster, self.clusters)
        light = _cell_light(layout, clusters)
        self.light = torch.from_numpy(light.sum(axis=1).astype(np.float32)).to(device)
        self.table = ClusterTable(torch.from_numpy(_defensive(light, clusters.total)).to(device))

    def cells(self, points: Tensor) -> Tensor:
        """Cell `[N]` of each point `[3, N]`; points outside belong to the nearest cell."""
        return _cells(points, *self._box)

    def sample_cluster(self, cells: Tensor, uniforms: Tensor) -> Tensor:
        """Clusters `[N]` for points in `cells` `[N]`, from uniform numbers `[N]`."""
        return sampled(self.table, cells, uniforms)

    def sample_within(self, cluster: Tensor, uniforms: Tensor) -> Tensor:
        """Triangles `[N]` of clusters `[N]`, by power, from uniform numbers `[2, N]`."""
        return self._within.sample(uniforms, cluster)

    def cluster(self, triangle: Tensor) -> Tensor:
        """Cluster `[N]` of each triangle."""
        return self._cluster.index_select(0, triangle)

    def pdf_within(self, triangle: Tensor) -> Tensor:
        """Probability `[N]` of choosing each triangle in its cluster."""
        return self._within.pdf(triangle)


def _direction_scale(centers: np.ndarray) -> float:
    """Length that a turn of a normal counts for beside a change of place: small lamps split last."""
    return 0.02 * float(np.linalg.norm(np.ptp(centers, axis=0)))


def _layout(centers: np.ndarray) -> _Layout:
    """A grid around the lamps."""
    low, high = centers.min(axis=0).astype(np.float64), centers.max(axis=0).astype(np.float64)
    margin = 0.25 * float(np.linalg.norm(high - low)) + 1e-3 * float(np.abs(high).max()) or 1e-6
    low, high = low - margin, high + margin
    cell = float((high - low).max()) / RESOLUTION
    return _Layout(low, cell, np.maximum(np.ceil((high - low) / cell), 1).astype(np.int64))


def _gathered(lamps: GridLamps, cluster: np.ndarray, count: int) -> _Clusters:
    """The lamps by cluster."""
    total = np.bincount(cluster, lamps.power, count)
    fields = np.concatenate((lamps.center, lamps.normal, lamps.axis, lamps.double_sided[:, None]), axis=1)
    means = np.stack([np.bincount(cluster, lamps.power * field, count) for field in fields.T], axis=1) / total[:, None]
    extent, outer = np.zeros(count), np.zeros(count)
    np.maximum.at(extent, cluster, np.linalg.norm(lamps.center - means[cluster, 0:3], axis=1))
    np.maximum.at(outer, cluster, lamps.outer)
    return _Clusters(total, means[:, 0:3], means[:, 3:6], means[:, 6:9], means[:, 9], extent, outer)


def _cell_light(layout: _Layout, clusters: _Clusters) -> np.ndarray:
    """Light that every cluster could send to every cell, unshadowed, `[cells, clusters]`."""
    offset = layout.middles()[:, None] - clusters.place[None]
    squared = np.maximum(np.square(offset).sum(axis=2), 0.25 * layout.cell**2)
    distance = np.sqrt(squared)
    cosine = np.einsum("ckd,kd->ck", offset, clusters.facing) / distance
    width = 1.0 - np.linalg.norm(clusters.facing, axis=1) + 0.5 * layout.cell / distance  # spread of normals and cell
    light = clusters.total * np.clip(cosine + width + 2.0 * clusters.both, 0.0, 1.0) / squared
    spots = np.flatnonzero(clusters.outer < np.pi)
    lit = _in_cones(layout.cell, offset[:, spots], distance[:, spots], _Clusters(*(field[spots] for field in clusters)))
    light[:, spots] *= lit | layout.is_outer()[:, None]
    return light


def _in_cones(cell: float, offset: np.ndarray, distance: np.ndarray, spots: _Clusters) -> np.ndarray:
    """Whether some of a cell at `offset` `[cells, spots, 3]` may lie in a cone of a cluster, bool `[cells, spots]`."""
    straight = np.linalg.norm(spots.axis, axis=1)
    cosine = np.einsum("ckd,kd->ck", offset, spots.axis) / (distance * np.maximum(straight, 1e-12))
    spread = 2.0 * np.arccos(np.clip(straight, 0.0, 1.0))  # of the axes
    reach = (0.5 * math.sqrt(3.0) * cell + spots.extent) / distance
    size = np.where(reach < 1.0, np.arcsin(np.minimum(reach, 1.0)), np.pi)
    return np.arccos(np.clip(cosine, -1.0, 1.0)) <= spots.outer + spread + size


def _defensive(weights: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Probability of every cluster in every cell: by its light, mixed with its share of the power."""
    by_power = power / power.sum()
    sums = weights.sum(axis=1, keepdims=True)
    guided = np.divide(weights, sums, out=np.broadcast_to(by_power, weights.shape).copy(), where=sums > 0.0)
    return (1.0 - DEFENSIVE) * guided + DEFENSIVE * by_power


@kernel
def _cells(points: Tensor, low: Tensor, scale: Tensor, last: Tensor, step: Tensor) -> Tensor:
    """Numbers `[N]` of the cells of a grid that points `[3, N]` lie in. Where it begins, the last cell and how numbers grow
    along each axis: `[3, 1]`; scale: cells to a metre, `[1, 1]`."""
    x, y, z = torch.minimum(((points - low) * scale).clamp(min=0.0), last).int() * step
    return x + y + z
