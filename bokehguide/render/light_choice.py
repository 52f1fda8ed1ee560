"""A choice of lights that was learnt: by place, among clusters of all that light samples may fall on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.alias import AliasTable
from bokehguide.render.clusters import ClusterTable, gather
from bokehguide.render.environment import EnvironmentLight, EnvironmentMap
from bokehguide.render.light_grid import LightGrid

BLOCKS = 64
"""Texels of a map are gathered by blocks, as many as this from pole to pole and twice as many around."""


@dataclass
class LightChoice:
    """How N paths are to choose among clusters of lights at their first surface.

    row: of the table for each path, int32 `[N]`. table: None while nothing is learnt. block: the step from which on
    it has been what it is; numbers that choose by it may be stratified from there on. seen: how much of each cluster's
    light may be expected to arrive, positive, `[rows, clusters]`, where that is learnt.
    """

    row: Tensor
    table: ClusterTable | None
    block: int
    seen: Tensor | None = None

    def select(self, index: Tensor) -> LightChoice:
        """That of the paths at `index`."""
        return LightChoice(self.row.index_select(0, index), self.table, self.block, self.seen)

    def pdf(self, cluster: Tensor) -> Tensor:
        """Probability `[N]` of each cluster."""
        return self.table.pdf(self.row, cluster)

    def visibility(self, cluster: Tensor) -> Tensor:
        """Share of each cluster's light that may be expected to arrive, `[N]`."""
        if self.seen is None:
            return torch.ones(cluster.shape, device=cluster.device)
        return self.seen.view(-1).index_select(0, self.row * self.seen.shape[1] + cluster)


class LightClusters:
    """Emissive triangles by place and direction, texels of the map by direction, and each sun alone; in this order.

    count: of all clusters; triangles: of those of triangles. Elements of the environment are as `EnvironmentLight.pick`
    has them.
    """

    def __init__(self, grid: LightGrid | None, environment: EnvironmentLight | None):
        self.triangles = grid.clusters if grid else 0
        self._map = _MapClusters(environment.map) if environment and environment.map and environment.map.power > 0.0 else None
        self._suns = environment.suns if environment else []
        self._first_sun = self.triangles + (self._map.count if self._map else 0)
        self.count = self._first_sun + len(self._suns)

    def pick(self, cluster: Tensor, uniforms: Tensor) -> Tensor:
        """Elements of the environment `[N]` from clusters `[N]` of it, by power, from uniform numbers `[2, N]`."""
        sun = self._first_sun - 1 - cluster
        if self._map is None:
            return sun
        texel = self._map.pick((cluster - self.triangles).clamp(0, self._map.count - 1), uniforms)
        return torch.where(sun < 0, sun, texel) if self._suns else texel

    def cluster(self, element: Tensor) -> Tensor:
        """Cluster `[N]` of each element of the environment."""
        sun = self._first_sun - 1 - element
        if self._map is None:
            return sun
        return torch.where(element < 0, sun, self.triangles + self._map.cluster(element.clamp(min=0)))

    def pdf_within(self, element: Tensor) -> Tensor:
        """Solid-angle density `[N]` of each element of the environment in its cluster."""
        density = torch.zeros(element.shape, device=element.device) if self._map is None else self._map.pdf(element.clamp(min=0))
        for number, disc in enumerate(self._suns, start=1):
            density = torch.where(element == -number, disc.density, density)
        return density

    def environment_pdf(self, choice: LightChoice, directions: Tensor, texel: Tensor) -> Tensor:
        """Solid-angle density `[N]` with which clusters of `choice` lead to unit directions `[3, N]`, which lie in these texels."""
        density = torch.zeros_like(directions[0])
        if self._map is not None:
            density = choice.pdf(self.triangles + self._map.cluster(texel)) * self._map.pdf(texel)
        for number, disc in enumerate(self._suns):
            share = choice.pdf(torch.full_like(texel, self._first_sun + number))
            density = density + share * disc.density * disc.contains(directions)
        return density


class _MapClusters:
    """Texels of a map: which cluster each is in, and their shares of it."""

    def __init__(self, light: EnvironmentMap):
        shares, device = light.shares(), light.texels.device
        tall, wide = -(-light.height // BLOCKS), -(-light.width // (2 * BLOCKS))
        down, across = -(-light.height // tall), -(-light.width // wide)
        edges = np.arange(0, light.height, tall), np.arange(0, light.width, wide)
        power = np.add.reduceat(np.add.reduceat(shares.astype(np.float64), edges[0], 0), edges[1], 1).reshape(-1)
        lit = np.flatnonzero(power > 0.0)
        of_lit, self.count = gather(_block_directions(lit // across, lit % across, down, across), power[lit])
        of_block = np.zeros(len(power), np.uint8)
        of_block[lit] = of_lit
        cluster = of_block.reshape(down, across).repeat(tall, 0)[: light.height].repeat(wide, 1)[:, : light.width].reshape(-1)
        order = np.argsort(cluster, kind="stable").astype(np.int32)
        starts = np.searchsorted(cluster[order], np.arange(self.count + 1))
        self._within = AliasTable(shares.reshape(-1)[order], device, starts)
        self._order, self._cluster = (torch.from_numpy(values).to(device) for values in (order, cluster))
        self._density = light.evenness()
        self._density[self._order.long()] *= self._within.probability

    def pick(self, cluster: Tensor, uniforms: Tensor) -> Tensor:
        """Texels `[N]` of clusters `[N]` from uniform numbers `[2, N]`."""
        return self._order.index_select(0, self._within.sample(uniforms, cluster))

    def cluster(self, texel: Tensor) -> Tensor:
        """Cluster `[N]` of each texel."""
        return self._cluster.index_select(0, texel).int()

    def pdf(self, texel: Tensor) -> Tensor:
        """Solid-angle density `[N]` of each texel in its cluster."""
        return self._density.index_select(0, texel)


def _block_directions(row: np.ndarray, column: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Unit directions `[K, 3]` of the middles of blocks, in a frame that turns with the map."""
    polar, around = np.pi * (row + 0.5) / rows, 2.0 * np.pi * (column + 0.5) / columns
    return np.stack((np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)), axis=1)
