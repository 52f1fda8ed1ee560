"""Weights of the primary hits that the pixels of a group reuse, and the radiance with these weights: see `pixel_reuse.py`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.render.vector import luminance
from bokehguide.runtime.indexing import scatter


class Hits(NamedTuple):
    """The primary hits of a batch, camera frame.

    plane: of the surface, `[3, N]` (see `Reservoirs`). depth: `[N]`. reusable: whether other pixels may use the hit, bool `[N]`.
    place: index of the sample in `PrimaryHits`, int64 `[N]`, -1 for none.
    """

    plane: Tensor
    depth: Tensor
    reusable: Tensor
    place: Tensor


class Views(NamedTuple):
    """J views: in a view, a pixel (viewer) sees the primary hit of another pixel (source).

    The views come in rows of viewers. Within a row, each pixel is the viewer of at most one view and the source of at most one.

    source, viewer: int64 `[J]`. points: lens points of the views, `[2, J]`. jacobian: |∂l' / ∂l| times the transmittance along
    the view, `[J]`. passing: W / A at the lens point, `[J]`. outgoing: unit directions from hits to lens points,
    `[3, J]`. on_surface: views whose hit is on a surface, int64 `[K]`. path_count: total number of paths of these hits. ends: 0,
    and the end of each row of viewers.
    """

    source: Tensor
    viewer: Tensor
    points: Tensor
    jacobian: Tensor
    passing: Tensor
    outgoing: Tensor
    on_surface: Tensor
    path_count: int
    ends: list[int]


class SeenPaths(NamedTuple):
    """Q paths of the hits on surfaces of a row of views. view: index into the views; path: of the primary hits, int64 `[Q]` each.
    bsdf: towards the lens points of the views, for the two directions of a path, `[3, Q]` each."""

    view: Tensor
    path: Tensor
    bsdf: tuple[Tensor, Tensor]

    @classmethod
    def of(cls, views: Views, hits: Hits, primary: PrimaryHits | None) -> SeenPaths | None:
        """The paths of `views`; None without any."""
        if primary is None or len(views.on_surface) == 0:
            return None
        place = hits.place.index_select(0, views.source.index_select(0, views.on_surface))
        index, path = primary.paths_of(place, views.path_count)
        view = views.on_surface.index_select(0, index)
        return cls(view, path, primary.bsdf(path, views.outgoing.index_select(1, view)))


class Weights(NamedTuple):
    """Weights of the samples of N pixels with P paths. scale: 1 / Σ_k V_k p_k, `[N]`. passing: W V / A at each pixel's own lens
    point, `[N]`. factors: f_s / Σ_k V_k p_k f_k, `[P]`, for the two directions of a path."""

    scale: Tensor
    passing: Tensor
    factors: list[Tensor]

    @property
    def of_own(self) -> Tensor:
        """Weight `[N]` of the lens point of each pixel's own sample."""
        return self.passing * self.scale


class Densities(NamedTuple):
    """Σ_k V_k p_k for each of N hits, `of_lens`, and Σ_k V_k p_k f_k for the two directions of each of P paths, `of_directions`.
    bsdf: f_s, `[P]` for each direction."""

    of_lens: Tensor
    of_directions: list[Tensor]
    bsdf: list[Tensor]

    @classmethod
    def of_own(cls, own: dict[str, Tensor], hits: PrimaryHits | None) -> Densities:
        """The summands of the pixels' own lens points."""
        of_lens = own["density"] * own.get("transmittance", 1.0)
        if hits is None:
            return cls(of_lens, [], [])
        bsdf = [luminance(value) for value in hits.reflection[0]]
        return cls(of_lens, [of_lens.index_select(0, hits.path_rays) * value for value in bsdf], bsdf)

    def add(self, density: Tensor, views: Views, seen: SeenPaths | None) -> None:
        """Add views with `density` `[J]`."""
        self.of_lens.index_add_(0, views.source, density)
        if seen is not None:
            for sums, value in zip(self.of_directions, seen.bsdf):
                sums.index_add_(0, seen.path, density.index_select(0, seen.view) * luminance(value))

    def weights(self, passing: Tensor) -> Weights:
        """passing: see `Weights`."""
        scale = torch.where(self.of_lens > 0.0, 1.0 / self.of_lens, 0.0)
        factors = [torch.where(sums > 0.0, value / sums, 0.0) for value, sums in zip(self.bsdf, self.of_directions)]
        return Weights(scale, passing, factors)


class Reused(NamedTuple):
    """The samples of N pixels after reuse.

    radiance: sum of weighted radiance over all hits that a pixel uses, `[3, N]`. weight: sum of the weights, `[N]`; its mean is
    1. light_groups: as `radiance`, of each light group, `[G, 3, N]`, None without groups.
    """

    radiance: Tensor
    weight: Tensor
    light_groups: Tensor | None = None


def own_radiance(paths: PathSamples, weights: Weights) -> Tensor:
    """Radiance `[3, N]` of the samples of the pixels themselves, times its weights."""
    radiance, hits = paths.radiance * weights.of_own, paths.primary_hits
    if hits is not None:
        # Reflected light has the weight of its direction in place of that of the lens point.
        of_lens, passing = (values.index_select(0, hits.path_rays) for values in (weights.scale, weights.passing))
        for value, incident, factor in zip(*hits.reflection, weights.factors):
            radiance.index_add_(1, hits.path_rays, value * incident * (passing * (factor - of_lens)))
    return radiance


def seen_radiance(
    views: Views, seen: SeenPaths | None, hits: Hits, paths: PathSamples, weight: Tensor, weights: Weights
) -> Tensor:
    """Radiance `[3, J]` of the samples as the viewers see them, times its weights.

    weight: of emission and of hits at infinity, `[J]`.
    """
    radiance, index = paths.radiance.index_select(1, views.source), views.on_surface
    if paths.primary_hits is not None and len(index) > 0:
        place = hits.place.index_select(0, views.source.index_select(0, index))
        scatter(radiance, index, paths.primary_hits.emitted(place, views.outgoing.index_select(1, index)))
    radiance = radiance * weight
    if paths.primary_hits is not None and seen is not None:
        share = (views.passing * views.jacobian).index_select(0, seen.view)
        for value, incident, factor in zip(seen.bsdf, paths.primary_hits.reflection[1], weights.factors):
            light = value * incident.index_select(1, seen.path) * (share * factor.index_select(0, seen.path))
            radiance.index_add_(1, seen.view, light)
    return radiance
