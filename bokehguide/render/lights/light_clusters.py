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
from bokehguide.render.vector import divisor

BLOCKS = 64
"""Number of blocks of texels from pole to pole; around the horizon, there are twice as many. Clusters consist of blocks."""


class LightClusters:
    """Clusters of emissive triangles by position and normal, then clusters of texels by direction, then one cluster for each
    distant light.

    count: number of all clusters. triangles: number of clusters of triangles. map: clusters of texels, None where the map is not
    sampled. first_distant: number of the first distant light's cluster. For elements, see `EnvironmentLight`.
    """

    def __init__(self, grid: LightVoxelGrid | None, environment: EnvironmentLight | None):
        self.triangles = grid.clusters if grid else 0
        self.map = MapClusters(environment.map) if environment and environment.map and environment.map.power > 0.0 else None
        self._distant = environment.distant if environment else []
        self.first_distant = self.triangles + (self.map.count if self.map else 0)
        self.count = self.first_distant + len(self._distant)

    def sample_element(self, cluster: Tensor, uniforms: Tensor) -> Tensor:
        """Elements `[N]` from clusters `[N]` of the environment, drawn by power from uniform numbers `[2, N]`."""
        distant = self.first_distant - 1 - cluster
        if self.map is None:
            return distant
        texel = self.map.sample_element((cluster - self.triangles).clamp(0, self.map.count - 1), uniforms)
        return torch.where(distant < 0, distant, texel) if self._distant else texel

    def cluster(self, element: Tensor) -> Tensor:
        """Cluster `[N]` of each element of the environment."""
        distant = self.first_distant - 1 - element
        if self.map is None:
            return distant
        return torch.where(element < 0, distant, self.triangles + self.map.cluster(element.clamp(min=0)))

    def pdf_within(self, element: Tensor) -> Tensor:
        """Solid-angle density `[N]` of each element of the environment within its cluster."""
        density = torch.zeros(element.shape, device=element.device) if self.map is None else self.map.pdf(element.clamp(min=0))
        for number, light in enumerate(self._distant, start=1):
            density = torch.where(element == -number, light.density, density)
        return density

    def environment_pdf(self, probability: Callable[[Tensor], Tensor], directions: Tensor, texel: Tensor) -> Tensor:
        """Solid-angle density `[N]` of unit directions `[3, N]` in the given texels; probability: of clusters `[N]`."""
        density = torch.zeros_like(directions[0])
        if self.map is not None:
            density = probability(self.triangles + self.map.cluster(texel)) * self.map.pdf(texel)
        for number, light in enumerate(self._distant):
            share = probability(torch.full_like(texel, self.first_distant + number))
            density = density + share * light.density * light.contains(directions)
        return density


class MapClusters:
    """Clusters of the texels of a map.

    count: number of clusters. within: choice among the texels of each cluster. order: texels sorted by cluster, int32 `[H W]`.
    clusters: cluster of each texel, uint8 `[H W]`. scale: density of a texel within its cluster over the density of the texel in
    the whole map, for each cluster, `[count]`.
    """

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
        self.within = AliasTable(shares.reshape(-1)[order], device, starts)
        self.order, self.clusters = (torch.from_numpy(values).to(device) for values in (order, cluster))
        self._density = light.density
        share = torch.zeros(self.count, dtype=torch.float64, device=device)
        share.index_add_(0, self.clusters.int(), light.probability.double())
        self.scale = (1.0 / divisor(share)).float()

    def sample_element(self, cluster: Tensor, uniforms: Tensor) -> Tensor:
        """Texels `[N]` of clusters `[N]` from uniform numbers `[2, N]`."""
        return self.order.index_select(0, self.within.sample(uniforms, cluster))

    def cluster(self, texel: Tensor) -> Tensor:
        """Cluster `[N]` of each texel."""
        return self.clusters.index_select(0, texel).int()

    def pdf(self, texel: Tensor) -> Tensor:
        """Solid-angle density `[N]` of each texel within its cluster."""
        return self._density(texel) * self.scale.index_select(0, self.cluster(texel))


def _block_directions(row: np.ndarray, column: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Unit directions `[K, 3]` of the centres of blocks, in the frame of the map."""
    polar, around = np.pi * (row + 0.5) / rows, 2.0 * np.pi * (column + 0.5) / columns
    return np.stack((np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)), axis=1)
