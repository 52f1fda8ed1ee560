"""Observers of paths: objects that a trace notifies of hits, light samples and arriving light."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.geometry import Surface
from bokehguide.render.lights.base import DirectLight
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.runtime.indexing import scatter


class PathObserver:
    """Base class of observers; all hooks do nothing.

    The tracer calls `primary_hit` and `primary_escape` once each at most, with rays, int64 `[K]`. Then, for
    each segment, it calls `arrival` (not for the primary one) and, where paths go on, `vertex`, `light_sample` and `scattered`,
    with paths, int64 `[K]`. Paths are numbered as the rays are; after `split`, anew.
    """

    def primary_hit(self, rays: Tensor, hit: Hit, surface: Surface, emission: Tensor) -> None:
        """Rays met surfaces first that send the radiance `emission` `[3, K]` along them."""

    def primary_escape(self, rays: Tensor, alpha: Tensor) -> None:
        """Rays met nothing but a visible environment, which hides the background with `alpha` `[K]`."""

    def split(self, rays: Tensor) -> None:
        """From here on, there are P paths, each of which belongs to one of `rays`, int64 `[P]`."""

    def vertex(self, paths: Tensor, hit: Hit, surface: Surface, owner: Tensor | None) -> None:
        """Paths scatter at surfaces `[K]`; owner: index into the fields of `hit` for each path, None for one each in order."""

    def light_sample(self, paths: Tensor, light: DirectLight, contribution: Tensor, visibility: Tensor) -> None:
        """Paths sampled lights at their vertices; contribution: radiance added `[3, K]`; visibility: share not blocked `[K]`."""

    def scattered(self, direction: Tensor, pdf: Tensor) -> None:
        """The paths of `vertex` go on in unit directions `[3, K]` of solid-angle density `[K]`."""

    def arrival(self, paths: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """Paths add radiance `[3, K]` of emitters they met at `distance` `[K]` from their last vertices, MISS_DISTANCE at
        infinity."""

    def finished(self, radiance: Tensor, distance: Tensor) -> None:
        """The trace found the radiance `[3, N]` along the rays, whose primary hits lie at `distance` `[N]`."""


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
