"""Interfaces of light sampling, between the path tracer and light samplers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self

from torch import Tensor

from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.geometry import Surface
from bokehguide.render.random import PixelRandom


class LightSample(NamedTuple):
    """Points on lights as N shading points see them, unshadowed.

    direction: unit, `[3, N]`; distance `[N]`, MISS_DISTANCE at infinity; radiance `[3, N]`; pdf: per solid angle, `[N]`.
    """

    direction: Tensor
    distance: Tensor
    radiance: Tensor
    pdf: Tensor


class ClusterRecord(NamedTuple):
    """Clusters of N light samples that a table of probabilities chose.

    row: of the table, int32 `[N]`; cluster: int32 `[N]`; contribution_rms: `[N]`, luminance of the contribution, unshadowed,
    times the root of the cluster's probability. The expected square is the sum over clusters of the second moments of their
    contributions.
    """

    row: Tensor
    cluster: Tensor
    contribution_rms: Tensor


@dataclass
class DirectLight:
    """Next-event estimates at N surfaces, unshadowed.

    direction: unit, `[3, N]`; distance `[N]`; value: reflected radiance over the density, times the MIS weight, `[3, N]`;
    bsdf_pdf: density with which the BSDF samples the direction, `[N]`; clusters: where a table of clusters chose the lights.
    """

    direction: Tensor
    distance: Tensor
    value: Tensor
    bsdf_pdf: Tensor
    clusters: ClusterRecord | None = None


class LightDistribution(Protocol):
    """Distribution of light samples at the vertices of N paths. All densities are per unit solid angle.

    first_step: step since which the distribution has not changed. Its random numbers may be stratified over the steps from there
    on.
    """

    @property
    def first_step(self) -> int: ...

    def select(self, index: Tensor) -> Self:
        """Distribution for the paths at `index`, int64 `[M]`."""
        ...

    def sample(self, surface: Surface, scattering: Scattering, uniforms: Tensor, random: PixelRandom) -> DirectLight:
        """Sample lights at surfaces `[N]` from uniform numbers `[6, N]`; random: source of further ones."""
        ...

    def triangle_pdf(self, points: Tensor, triangle: Tensor, distance: Tensor, cosine: Tensor) -> Tensor:
        """Density `[N]` with which points `[3, N]` sample `triangle` at `distance` under `cosine`; 0 where it emits nothing."""
        ...

    def environment_pdf(self, points: Tensor, directions: Tensor) -> Tensor:
        """Density `[N]` with which points `[3, N]` sample directions `[3, N]` of the environment."""
        ...


class LightSampler(Protocol):
    """Chooses a distribution of light samples by the position of a surface."""

    def at(self, points: Tensor) -> LightDistribution:
        """Distribution at points `[3, N]` in world space."""
        ...
