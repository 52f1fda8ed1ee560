"""Clusters of all emitters of a scene for light sampling."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.lights.alias_table import AliasTable
from bokehguide.render.lights.clusters import build_clusters
from bokehguide.render.lights.environment import EnvironmentLight, EnvironmentMap
from bokehguide.render.lights.voxel_grid import LightVoxelGrid

BLOCKS = 64
"""Number of blocks of texels from pole to pole; around the horizon, there are twice as many. Clusters consist of blocks."""


class LightClusters:
    """Clusters of emissive triangles by position and normal, then clusters of texels by direction, then one cluster for each
    distant light.

    count: number of all clusters. triangles: number of clusters of triangles. For elements, see `EnvironmentLight`.
    """

    def __init__(self, grid: LightVoxelGrid | None, environment: EnvironmentLight | None):
        self.triangles = grid.clusters if grid else 0
        self._map = _MapClusters(environment.map) if environment and environment.map and environment.map.power > 0.0 else None
        self._distant = environment.distant if environment else []
        self._first_distant = self.triangles + (self._map.count if self._map else 0)
        self.count = self._first_distant + len(self._distant)

    def sample_element(self, cluster: Tensor, uniforms: Tensor) -> Tensor:
        """Elements `[N]` from clusters `[N]` of the environment, drawn by power from uniform numbers `[2, N]`."""
        distant = self._first_distant - 1 - cluster
        if self._map is None:
            return distant
        texel = self._map.sample_element((cluster - self.triangles).clamp(0, self._map.count - 1), uniforms)
        return torch.where(distant < 0, distant, texel) if self._distant else texel

    def cluster(self, element: Tensor) -> Tensor:
        """Cluster `[N]` of each element of the environment."""
        distant = self._first_distant - 1 - element
        if self._map is None:
            return distant
        return torch.where(element < 0, distant, self.triangles + self._map.cluster(element.clamp(min=0)))

    def pdf_within(self, element: Tensor) -> Tensor:
        """Solid-angle density `[N]` of each element of the environment within its cluster."""
        density = torch.zeros(element.shape, device=element.device) if self._map is None else self._map.pdf(element.clamp(min=0))
        for number, light in enumerate(self._distant, start=1):
            density = torch.where(element == -number, light.density, density)
        return density

    def environment_pdf(self, probability: Callable[[Tensor], Tensor], directions: Tensor, texel: Tensor) -> Tensor:
        """Solid-angle density `[N]` of unit directions `[3, N]` in the given texels; probability: of clusters `[N]`."""
        density = torch.zeros_like(directions[0])
        if self._map is not None:
            density = probability(self.triangles + self._map.cluster(texel)) * self._map.pdf(texel)
        for number, light in enumerate(self._distant):
            share = probability(torch.full_like(texel, self._first_distant + number))
            density = density + share * light.density * light.contains(directions)
        return density


class _MapClusters:
    """Clusters of the texels of a map."""

    def __init__(self, light: EnvironmentMap):
        shares, device = light.shares(), light.texels.device
        tall, wide = -(-light.height // BLOCKS), -(-light.width // (2 * BLOCKS))
        down, across = -(-light.height // tall), -(-light.width // wide)
        edges = np.arange(0, light.height, tall), np.arange(0, light.width, wide)
        power = np.add.reduceat(np.add.reduceat(shares.astype(np.float64), edges[0], 0), edges[1], 1).reshape(-1)
        lit = np.flatnonzero(power > 0.0)
        of_lit, self.count = build_clusters(_block_directions(lit // across, lit % across, down, across), power[lit])
        of_block = np.zeros(len(power), np.uint8)
        of_block[lit] = of_lit
        cluster = of_block.reshape(down, across).repeat(tall, 0)[: light.height].repeat(wide, 1)[:, : light.width].reshape(-1)
        order = np.argsort(cluster, kind="stable").astype(np.int32)
        starts = np.searchsorted(cluster[order], np.arange(self.count + 1))
        self._within = AliasTable(shares.reshape(-1)[order], device, starts)
        self._order, self._cluster = (torch.from_numpy(values).to(device) for values in (order, cluster))
        self._density = light.uniform_density()
        self._density[self._order.long()] *= self._within.probability

    def sample_element(self, cluster: Tensor, uniforms: Tensor) -> Tensor:
        """Texels `[N]` of clusters `[N]` from uniform numbers `[2, N]`."""
        return self._order.index_select(0, self._within.sample(uniforms, cluster))

    def cluster(self, texel: Tensor) -> Tensor:
        """Cluster `[N]` of each texel."""
        return self._cluster.index_select(0, texel).int()

    def pdf(self, texel: Tensor) -> Tensor:
        """Solid-angle density `[N]` of each texel within its cluster."""
        return self._density.index_select(0, texel)


def _block_directions(row: np.ndarray, column: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Unit directions `[K, 3]` of the centres of blocks, in the frame of the map."""
    polar, around = np.pi * (row + 0.5) / rows, 2.0 * np.pi * (column + 0.5) / columns
    return np.stack((np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)), axis=1)
