"""Batches of paths as the path tracer extends them, segment by segment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.lights.base import LightDistribution
from bokehguide.render.random import PixelRandom
from bokehguide.runtime.indexing import scatter_add


class Rays(NamedTuple):
    """Next segments of N paths.

    vertex: last vertex, which is the origin of light samples, `[3, N]`. origin: origin of the ray, at an offset from the surface,
    `[3, N]`. direction: unit, `[3, N]`. pdf: density of the direction, `[N]`. alive: positive for continuing paths, `[N]`, None
    if all paths continue. Values of ended paths are undefined.
    """

    vertex: Tensor
    origin: Tensor
    direction: Tensor
    pdf: Tensor
    alive: Tensor | None = None

    def select(self, index: Tensor) -> Rays:
        """Rays at `index`, int64 `[M]`, all alive."""
        return Rays(*(values.index_select(-1, index) for values in self[:4]))


@dataclass
class Paths:
    """N continuing paths. A path that ends is removed.

    collected: radiance `[3, M]` of M rays. A path that ends adds its radiance to the entry `index`. index: int64 `[N]`.
    throughput, radiance: `[3, N]`. lights: distribution of light samples at the last vertices. shadow_threshold: see
    `PathTracer.trace`, `[N]`.
    """

    collected: Tensor
    index: Tensor
    throughput: Tensor
    radiance: Tensor
    random: PixelRandom
    lights: LightDistribution
    shadow_threshold: Tensor | None = None

    def select(self, index: Tensor) -> Paths:
        """Paths at `index`, int64 `[M]`."""
        place, throughput, radiance = (x.index_select(-1, index) for x in (self.index, self.throughput, self.radiance))
        threshold = None if self.shadow_threshold is None else self.shadow_threshold.index_select(0, index)
        random, lights = self.random.select(index), self.lights.select(index)
        return Paths(self.collected, place, throughput, radiance, random, lights, threshold)

    def split(self, counts: Tensor, total: int) -> tuple[Paths, Tensor]:
        """Replace each path by `counts`, int64 `[N]`, adjacent paths with equal shares of the throughput.

        Returns `total` new paths, and the old path of each new path, int64 `[total]`. The new paths have their own array of
        collected radiance. The first new path of each old path keeps the random numbers.
        """
        self.finish()
        owner = torch.repeat_interleave(counts, output_size=total)
        place = torch.arange(len(owner), device=owner.device)
        number = place - (counts.cumsum(0) - counts).index_select(0, owner)
        paths = self.select(owner)
        paths.throughput /= counts.index_select(0, owner)
        paths.radiance = torch.zeros_like(paths.radiance)
        paths.collected, paths.index = torch.zeros_like(paths.radiance), place
        paths.random = paths.random.copies(number)
        return paths, owner

    def finish(self) -> None:
        """End all paths: collect their radiance."""
        scatter_add(self.collected, self.index, self.radiance)

    def end(self, ended: Tensor) -> None:
        """Collect the radiance of the paths `ended`, int64 `[K]`. A throughput of NaN makes the radiance NaN."""
        invalid = 0.0 * self.throughput.index_select(1, ended)
        scatter_add(self.collected, self.index.index_select(0, ended), self.radiance.index_select(1, ended) + invalid)
