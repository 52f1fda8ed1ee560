"""Interfaces of light sampling, between the path tracer and light samplers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import NamedTuple, Protocol, Self

import torch
from torch import Tensor

from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.mis import BsdfWeights
from bokehguide.render.random import PixelRandom
from bokehguide.render.surface import Surface


class LightSample(NamedTuple):
    """Points on lights, sampled from N shading points, without shadows.

    direction: unit, `[3, N]`; distance `[N]`, MISS_DISTANCE at infinity; radiance `[3, N]`; pdf: per solid angle, `[N]`;
    triangle: int32 `[N]`, -1 at infinity.
    """

    direction: Tensor
    distance: Tensor
    radiance: Tensor
    pdf: Tensor
    triangle: Tensor


class ClusterRecord(NamedTuple):
    """Clusters of N light samples, if a table of probabilities has chosen the clusters.

    row: row of the table, int32 `[N]`. cluster: int32 `[N]`. contribution_rms: luminance of the unshadowed contribution times the
    square root of the cluster's probability, `[N]`. The expected value of its square is the sum over clusters of the second
    moments of their contributions. broad: broad part of the MIS weight (`mis.broad_share`) over the weight, `[N]`.
    """

    row: Tensor
    cluster: Tensor
    contribution_rms: Tensor
    broad: Tensor


@dataclass
class DirectLight:
    """Next-event estimates at N surfaces, without shadows.

    direction: unit, `[3, N]`. distance: `[N]`. value: reflected radiance times the MIS weight, over the density, `[3, N]`.
    bsdf_pdf: density with which BSDF sampling draws the direction, `[N]`. triangle: see `LightSample`. clusters: record of the
    clusters if a table has chosen them.
    """

    direction: Tensor
    distance: Tensor
    value: Tensor
    bsdf_pdf: Tensor
    triangle: Tensor
    clusters: ClusterRecord | None = None

    def thinned(self, factor: Tensor) -> DirectLight:
        """The samples after a roulette with factors `[N]` (`roulette_factor`). Ended samples have the cluster -1.

        The expected values of `value` and of the square of `contribution_rms` stay the same.
        """
        clusters = self.clusters
        if clusters is not None:
            cluster, rms = torch.where(factor > 0.0, clusters.cluster, -1), clusters.contribution_rms * factor.sqrt()
            clusters = clusters._replace(cluster=cluster, contribution_rms=rms)
        return replace(self, value=self.value * factor, clusters=clusters)


class LightDistribution(Protocol):
    """Distribution of light samples at the vertices of N paths. All densities are per unit solid angle.

    first_step: step since which the distribution has not changed. Its random numbers may be stratified over the steps from this
    step on.
    """

    @property
    def first_step(self) -> int: ...

    def select(self, index: Tensor) -> Self:
        """Distribution for the paths at `index`, int64 `[M]`."""
        ...

    def sample(self, surface: Surface, scattering: Scattering, uniforms: Tensor, random: PixelRandom) -> DirectLight:
        """Sample lights at surfaces `[N]` from uniform numbers `[6, N]`; random: source of further uniform numbers."""
        ...

    def triangle_pdf(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor) -> Tensor:
        """Density `[N]` with which points `[3, N]` sample `triangle`; 0 if the triangle emits no light.

        distance: from the points to the triangle, `[N]`. cosine: between direction and normal of the triangle, `[N]`.
        """
        ...

    def environment_pdf(self, points: Tensor, directions: Tensor) -> Tensor:
        """Density `[N]` with which points `[3, N]` sample directions `[3, N]` of the environment."""
        ...

    def triangle_weights(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor, pdf: Tensor) -> BsdfWeights:
        """MIS weights of BSDF samples with the density `pdf` `[N]` that meet `triangle`; other arguments: see `triangle_pdf`."""
        ...

    def environment_weights(self, points: Tensor, directions: Tensor, pdf: Tensor) -> BsdfWeights:
        """MIS weights of BSDF samples with the density `pdf` `[N]` that leave the scene in `directions` `[3, N]`."""
        ...


class LightSampler:
    """Base class: selects a distribution of light samples for each surface by its position.

    in_core: whether the native core can draw from the distributions.
    """

    in_core = False

    def at(self, points: Tensor) -> LightDistribution:
        """Distribution at points `[3, N]` in world space."""
        raise NotImplementedError

    def core_lights(self, core: ModuleType) -> object | None:
        """The present distributions, as `ClusterLights` of the native core; None for those of the `PowerLightSampler`."""
        return None
