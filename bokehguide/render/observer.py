"""Observers of paths: objects that receive the hits, the light samples and the arriving light of a trace."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.lights.base import DirectLight
from bokehguide.render.surface import Surface
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.runtime.indexing import scatter


class PathObserver:
    """Base class of observers; all hooks do nothing.

    The path tracer calls `primary_hit` and `primary_escape` at most once each, with rays, int64 `[K]`. For each later segment,
    the path tracer calls `arrival`. If paths continue after a segment, it calls `vertex`, `light_sample` and `scattered`. The
    arguments are paths, int64 `[K]`. The number of a path is the number of its ray. After `split`, paths have new numbers.

    in_core: whether `reported` replaces all other hooks where the native core traces the paths.
    """

    in_core = False

    def primary_hit(self, rays: Tensor, hit: Hit, surface: Surface, emission: Tensor) -> None:
        """Rays have primary hits on surfaces that emit the radiance `emission` `[3, K]` along the rays."""

    def primary_escape(self, rays: Tensor, alpha: Tensor) -> None:
        """Rays left the scene and see the environment with the opacity `alpha` `[K]`."""

    def split(self, rays: Tensor) -> None:
        """Rays split into P paths. Path i belongs to `rays[i]`, int64 `[P]`."""

    def vertex(self, paths: Tensor, hit: Hit, surface: Surface, owner: Tensor | None) -> None:
        """Paths scatter at surfaces `[K]`; owner: index of each path into the fields of `hit`, None for the same order."""

    def light_sample(self, paths: Tensor, light: DirectLight, contribution: Tensor, visibility: Tensor) -> None:
        """Paths have sampled lights at vertices; contribution: added radiance `[3, K]`; visibility: unblocked share `[K]`."""

    def scattered(self, direction: Tensor, pdf: Tensor) -> None:
        """The paths of the last `vertex` call continue in unit directions `[3, K]` with the solid-angle densities `[K]`."""

    def arrival(self, paths: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """Paths have met emitters at `distance` `[K]` from the last vertices, and add radiance `[3, K]`.

        The distance of an emitter at infinity is MISS_DISTANCE.
        """

    def emitter(self, paths: Tensor, radiance: Tensor, triangle: Tensor | None, direction: Tensor) -> None:
        """Rays or paths have met emitters, and add radiance `[3, K]`: triangles, int32 `[K]`, None for lights at infinity.

        direction: unit, of the segments, `[3, K]`. The path tracer calls this method for primary hits as well.
        """

    def broad_light(self, paths: Tensor, radiance: Tensor) -> None:
        """BSDF samples of primary hits have met lights; radiance: the light times the broad part of the MIS weight of light
        samples (`BsdfWeights`), `[3, K]`."""

    def finished(self, radiance: Tensor, distance: Tensor) -> None:
        """The trace has ended, with the radiance `[3, N]` along the rays and the distances `[N]` of the primary hits."""

    def reported(self, report: CoreReport) -> None:
        """The native core has traced all paths."""


class CoreReport(NamedTuple):
    """Report of the native core on a trace of N rays that split into P paths.

    radiance: along the rays, `[3, N]`. distance: of the primary hits, `[N]`. images: virtual images, `[3, N]`. The first row is
    the luminance that arrives by way of mirrors and glass, and the second row is the distance of the brightest image. The third
    row is 1 if a path leaves the primary hit as in a mirror or glass, else 0. light_samples: light samples at primary hits, None
    if no table chose their clusters. The tensors `[P]` are the fields of `LightSamples`.
    """

    radiance: Tensor
    distance: Tensor
    images: Tensor
    light_samples: tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None


class PrimaryHitAOVs(PathObserver):
    """AOVs of the primary hits of N rays; the fields are those of `PathSamples`."""

    def __init__(self, count: int, device: torch.device):
        self.normal, self.albedo, self.emission = torch.zeros(3, 3, count, device=device)
        self.distance = torch.full((count,), MISS_DISTANCE, device=device)
        self.alpha = torch.zeros(count, device=device)
        self.triangle = torch.full((count,), -1, dtype=torch.int32, device=device)

    def primary_hit(self, rays: Tensor, hit: Hit, surface: Surface, emission: Tensor) -> None:
        scatter(self.distance, rays, hit.distance)
        scatter(self.triangle, rays, hit.triangle)
        scatter(self.normal, rays, surface.normal)
        scatter(self.albedo, rays, surface.base_color)
        scatter(self.emission, rays, emission)
        self.alpha.scatter_(0, rays, 1.0)

    def primary_escape(self, rays: Tensor, alpha: Tensor) -> None:
        self.alpha[rays] = alpha
