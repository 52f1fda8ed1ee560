"""Reuse of primary hits among neighbouring pixels: each pixel sees the hits of its group through a lens point of its own.

Many pixels see a point that is out of focus. The light of the paths from a primary hit of one pixel goes to the other
pixels of its group as well (Bekaert, Sbert and Halton 2002): through the lens point from which the other pixel's focus point
and the same surface are in line, by Area ReSTIR's reconnection (`models/reconnection.py`), if nothing blocks the ray.

The combination is multiple importance sampling with the balance heuristic. A point x that the densities
p_k = q_k |∂l_k / ∂x| of a group's pixels k find counts for pixel i as W V_i |∂l_i / ∂x| / (A Σ_k V_k p_k). V is the visibility
from a pixel. A point in focus is seen by one pixel alone, and counts as W / (A q). At silhouettes a shading normal may face
one of two pixels and be replaced for the other: x is not the same surface for both, and V is 0 between them.

Groups are tiles of the film that lie elsewhere in every step, wide or high, so that no tile shows. They end where bands of rows
and of columns end, so that ranks, batches and the blocks of adaptive sampling hold whole groups. The noise of the pixels of a
group is correlated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.control_variate import ControlVariate, NoControlVariate
from bokehguide.guiding.protocols import BatchSamples, LensQuery, ModeContext, SampleReuse, StepSummary
from bokehguide.models.reconnection import reconnect, reconnection_jacobian
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import FilmSamples
from bokehguide.render.lens import Lens
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.render.random import hash_int
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import dot, length
from bokehguide.runtime.compile.kernels import kernel
from bokehguide.runtime.device import to_device
from bokehguide.runtime.distributed import ROWS_PER_BAND
from bokehguide.runtime.indexing import ActiveEntries, Pixels, indices, pixel_numbers, scatter
from bokehguide.runtime.timer import PhaseTimer

COLUMNS = 32
"""Columns of a film after which groups end."""
GROUP_SPACING = 3.0
"""Mean distance between the pixels of a group, pixels."""
PAIRS_AT_ONCE = 65536
"""Pairs of pixels that a CPU handles together, about: more would leave the cache, and fewer would cost more Python."""
NOWHERE, INFINITE = 1e15, 1e30


class Reused(NamedTuple):
    """The samples of N pixels after reuse: Σ W L / (A q) over all pixels that found them, `[3, N]`, and the sum of the weights
    alone, whose mean is 1, `[N]`."""

    radiance: Tensor
    weight: Tensor


class _Hits(NamedTuple):
    """The primary hits of a batch, camera frame: plane `[3, N]` of the surface (see `Reservoirs`), depth `[N]`, and whether
    others may reuse the hit, bool `[N]`; place: of the sample among the primary hits, int64 `[N]`, -1 for none."""

    plane: Tensor
    depth: Tensor
    reusable: Tensor
    place: Tensor


class _Views(NamedTuple):
    """J views of hits by other pixels. In one row of viewers, no pixel views or is viewed twice.

    source, viewer: pixel that found the hit and pixel that views it, int64 `[J]`. points: lens points of the views `[2, J]`.
    jacobian: |∂l' / ∂l| times the transmittance of the view; passing: W / A at the lens point; `[J]`. outgoing: unit directions
    from the hits to the lens points `[3, J]`. on_surface: views of surfaces, int64 `[K]`; path_count: number of their paths in
    all. ends: where the views of each row of viewers end, the first at 0.
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


class _LensRays(NamedTuple):
    """Rays from hits to lens points.

    outgoing: unit directions of the light; origin, direction: world frame, `[3, J]`; distance: length, `[J]`, MISS_DISTANCE from
    hits at infinity; path_counts: numbers of paths whose light arrives, 0 below the surface, `[J]`.
    """

    outgoing: Tensor
    origin: Tensor
    direction: Tensor
    distance: Tensor
    path_counts: Tensor


class PixelPathReuse:
    """Reuses the samples of the pixels of a film. Threads may call it side by side, with batches of whole groups.

    width: of the film, pixels; seed: of the groups' places; group: pixels along the longer and the shorter side of a group;
    min_spread: see `GuidedConfig`.
    """

    def __init__(
        self,
        camera: ThinLensCamera,
        tracer: PathTracer,
        width: int,
        seed: int,
        group: tuple[int, int] = GuidedConfig.reuse_group,
        min_spread: float = GuidedConfig.min_spread,
    ):
        self._camera, self._tracer, self._width, self._seed = camera, tracer, width, seed
        self._group, self._min_spread = group, min_spread

    def reuse(self, samples: BatchSamples, timer: PhaseTimer) -> Reused:
        """Reuse the samples of one batch. Its rays are added to `paths.rays`. Samples that are not finite stay in their pixel."""
        lens, paths, batch, drawn = self._camera.lens, samples.paths, samples.batch, samples.drawn
        hits = self._hits(samples)
        transmittance = self._own_transmittance(hits, samples, timer)
        total, rows = samples.query.own_pdf(drawn) * transmittance, []
        key = hash_int(hash_int(self._seed ^ 0x68E31DA4) + batch.step)
        members = _members(batch.places, self._width, key, self._group, total.device)
        together = max(1, PAIRS_AT_ONCE // len(total)) if total.device.type == "cpu" else len(members)
        for viewers in members.split(together) if len(members) > 0 else ():
            views = self._views(viewers, hits, samples, timer)
            if len(views.source) > 0:
                total.index_add_(0, views.source, _densities(samples.query, views, len(total)) * views.jacobian)
                rows.append(views)
        scale = torch.where(total > 0.0, 1.0 / total, 0.0)
        weight = torch.where(drawn.weight > 0.0, _passing(lens, drawn.points, batch.focus) * transmittance * scale, 0.0)
        reused = Reused(paths.radiance * weight, weight)
        for views in rows:
            weight = (views.passing * views.jacobian * scale.index_select(0, views.source)).nan_to_num(0.0, 0.0, 0.0)
            light = (_radiance(views, hits, paths) * weight).nan_to_num(0.0, 0.0, 0.0)
            reused.radiance.index_add_(1, views.viewer, light)
            reused.weight.index_add_(0, views.viewer, weight)
        return reused

    def _hits(self, samples: BatchSamples) -> _Hits:
        camera, hits, depth = self._camera, samples.paths.primary_hits, samples.film.depth
        device, environment = depth.device, self._tracer.lights.environment
        place = torch.full(depth.shape, -1, device=device)
        plane = torch.zeros(3, *depth.shape, device=device)
        plane[2] = 1.0
        infinite = (samples.paths.triangle < 0) & (samples.drawn.weight > 0.0)
        reusable = infinite & (environment is not None and environment.visible)
        if hits is not None:
            normal = camera.axes.T @ hits.surface.geometric_normal
            position = camera.axes.T @ (hits.surface.position - camera.position)
            scatter(plane, hits.rays, torch.cat((normal[:2], dot(position, normal)[None])))
            scatter(place, hits.rays, torch.arange(len(hits.rays), device=device))
            angle = self._view_angle(position[2].clamp(min=1e-9))
            scatter(reusable, hits.rays, self._looks_alike(hits, self._min_spread * angle))
        return _Hits(plane, torch.where(infinite, INFINITE, depth), reusable, place)

    def _view_angle(self, depth: Tensor) -> Tensor:
        """Angle in radians `[N]` between the lens points through which pixels of a group see a point at `depth` `[N]`, about."""
        camera, focus = self._camera, self._camera.lens.focus_distance
        spacing = GROUP_SPACING * camera.pixel_slope * focus * depth / (depth - focus).abs().clamp(min=1e-9)
        return spacing.clamp(max=2.0 * camera.lens.radius) / depth

    def _looks_alike(self, hits: PrimaryHits, least: Tensor) -> Tensor:
        """Primary hits that look alike from all lens points of a group: opaque, with α of at least `least`; bool `[K]`.

        Paths of one pixel do not know the reflection that another pixel sees in a smoother surface.
        """
        surface, materials = hits.surface, self._tracer.geometry.materials
        alike = (surface.alpha >= least) & (surface.facing > 0.0)
        if surface.clearcoat is not None and surface.clearcoat_alpha is not None:
            alike &= (surface.clearcoat <= 0.0) | (surface.clearcoat_alpha >= least)
        if materials.has_transmission:
            alike &= surface.transmission * (1.0 - surface.metallic) <= 0.0
        if materials.absorbs:  # the absorption depends on the length of the path
            alike &= surface.front > 0.0
        return alike

    def _own_transmittance(self, hits: _Hits, samples: BatchSamples, timer: PhaseTimer) -> Tensor:
        """Transmittance `[N]` of the translucent surfaces before the pixels' own hits, as `_views` has it for other pixels."""
        if not self._tracer.geometry.materials.has_translucent:
            return torch.ones_like(hits.depth)
        rays = self._lens_rays(hits.place, samples.drawn.points, samples.batch.focus, samples.paths.primary_hits)
        counts = rays.path_counts * hits.reusable
        transmittance, traced = self._tracer.visibility.transmittance(rays.origin, rays.direction, rays.distance, counts, timer)
        samples.paths.rays += traced
        return torch.where(hits.reusable, transmittance, 1.0)

    def _views(self, viewers: Tensor, hits: _Hits, samples: BatchSamples, timer: PhaseTimer) -> _Views:
        """The views of all hits by each row of pixels of `viewers`, int64 `[R, N]`, -1 for none."""
        rows, count = viewers.shape
        viewer = viewers.flatten()
        focus_of_viewer = samples.batch.focus.index_select(1, viewer.clamp(min=0))
        own = (samples.drawn.points, samples.batch.focus, hits.depth, hits.plane, hits.reusable)
        points, focus, depth, plane, reusable = (_repeated(values, rows) for values in own)
        through, jacobian = _reconnected(points, focus, focus_of_viewer, depth, plane)
        passing = _passing(self._camera.lens, through, focus_of_viewer) * reusable * (viewer >= 0)
        index = ActiveEntries(passing > 0.0).index
        source = torch.arange(count, device=index.device).repeat(rows)
        place = hits.place.index_select(0, source.index_select(0, index))
        points, focus = through.index_select(1, index), focus_of_viewer.index_select(1, index)
        rays = self._lens_rays(place, points, focus, samples.paths.primary_hits)
        counts = rays.path_counts * (passing.index_select(0, index) > 0.0)
        arriving, traced = self._tracer.visibility.visible_rays(rays.origin, rays.direction, rays.distance, counts, timer)
        samples.paths.rays += traced
        # The host knows which rays arrive, and with them the sizes of all arrays that follow.
        begins = torch.arange(rows + 1) * count
        ends = torch.searchsorted(arriving.rays, begins if index.device.type != "cpu" else torch.searchsorted(index, begins))
        on_surface = indices(arriving.distance < MISS_DISTANCE)
        path_count = int(arriving.weight.index_select(0, on_surface).sum(dtype=torch.float64))
        left = to_device(arriving.rays, index.device)
        index, outgoing = index.index_select(0, left), rays.outgoing.index_select(1, left)
        every = (source, viewer, through, jacobian, passing)
        source, viewer, through, jacobian, passing = (values.index_select(-1, index) for values in every)
        on_surface = to_device(on_surface, index.device)
        jacobian = jacobian * arriving.transmittance
        return _Views(source, viewer, through, jacobian, passing, outgoing, on_surface, path_count, ends.tolist())

    def _lens_rays(self, place: Tensor, points: Tensor, focus: Tensor, hits: PrimaryHits | None) -> _LensRays:
        """Rays to lens points `[2, J]` from the primary hits at `place` `[J]`; from infinity beyond `focus` `[3, J]` for -1."""
        if hits is None:
            ray = self._camera.rays(focus, points)
            distance = torch.full_like(points[0], MISS_DISTANCE)
            return _LensRays(torch.zeros_like(focus), *ray, distance, torch.ones_like(distance))
        far, chosen, surface = place < 0, place.clamp(min=0), hits.surface
        ends = (values.index_select(-1, chosen) for values in (surface.position, surface.geometric_normal, surface.offset))
        on_lens = self._camera.axes[:, :2] @ points + self._camera.position
        outgoing, above, origin, direction, distance = _ray_to(on_lens, *ends)
        leaves = above & hits.same_normals(chosen, outgoing)
        counts = hits.counts.index_select(0, chosen) * leaves.to(torch.float32)
        at_infinity = ActiveEntries(far)
        if len(at_infinity) > 0:
            ray = self._camera.rays(at_infinity.select(focus), at_infinity.select(points))
            for values, new in ((origin, ray[0]), (direction, ray[1]), (distance, MISS_DISTANCE), (counts, 1.0)):
                at_infinity.scatter(values, new)
        return _LensRays(outgoing, origin, direction, distance, counts)


class PixelReuse(SampleReuse):
    """The sample reuse of the mode `guided`: `PixelPathReuse`, with the weights as a control variate for the radiance."""

    learns = True
    weighted = True

    def __init__(self, context: ModeContext, config: GuidedConfig):
        super().__init__()
        seed, group, spread = context.settings.seed, config.reuse_group, config.min_spread
        self.paths = PixelPathReuse(context.camera, context.tracer, context.film_width, seed, group, spread)
        # Where the lens vignettes, the mean weight is not known.
        known = config.control_variate and not context.camera.lens.vignettes
        self.control_variate = ControlVariate(context, config.control_shrinkage) if known else NoControlVariate()

    def cuts(self, width: int, height: int) -> np.ndarray:
        return np.append(np.arange(0, width * height, ROWS_PER_BAND * width), width * height)

    def expose(self, samples: BatchSamples, film: Callable[[Pixels, FilmSamples], Tensor], timer: PhaseTimer) -> Tensor:
        places, reused = samples.batch.places, self.paths.reuse(samples, timer)
        radiance = self.control_variate.corrected(places, reused.radiance, reused.weight)
        ones = torch.ones_like(reused.weight)
        return film(places, replace(samples.film, radiance=radiance, radiance_weight=ones))

    def update(self, summary: StepSummary) -> None:
        if summary.ends_epoch:
            self.control_variate.update(summary.picture)

    def merge(self) -> None:
        self.control_variate.merge()


def _densities(query: LensQuery, views: _Views, count: int) -> Tensor:
    """q of the viewers, of `count` pixels, at the lens points of the views, `[J]`."""
    if not query.varies:
        return query.pdf(views.points)
    found = []
    for first, end in pairwise(views.ends):
        viewer = views.viewer[first:end]
        points = torch.full((2, count), NOWHERE, device=viewer.device)
        scatter(points, viewer, views.points[:, first:end])
        found.append(query.pdf(points).index_select(0, viewer))
    return torch.cat(found)


def _radiance(views: _Views, hits: _Hits, paths: PathSamples) -> Tensor:
    """Radiance `[3, J]` of the samples as the viewers see them."""
    radiance, index = paths.radiance.index_select(1, views.source), views.on_surface
    if len(index) > 0:
        assert paths.primary_hits is not None
        place = hits.place.index_select(0, views.source.index_select(0, index))
        outgoing = views.outgoing.index_select(1, index)
        scatter(radiance, index, paths.primary_hits.radiance(place, outgoing, views.path_count))
    return radiance


def _members(places: Pixels, width: int, key: int, group: tuple[int, int], device: torch.device) -> Tensor:
    """For each other place in a group, the pixel there for each of N pixels, by its number among them, int64 `[.., N]`, or -1.

    places: of the pixels on a film of this width; key: random bits for the origin of the groups.
    """
    numbers = pixel_numbers(places, device)
    first, last = (places.start, places.stop - 1) if isinstance(places, slice) else (int(places[0]), int(places[-1]))
    among = torch.full((last - first + 2,), -1, device=device)  # the last entry is shared by all other places
    among[numbers - first] = torch.arange(len(numbers), device=device)
    there = numbers - first + _offsets(width, key, group, device).index_select(1, numbers % (ROWS_PER_BAND * width))
    there = torch.where((there >= 0) & (there < len(among)), there, len(among) - 1)
    return among.index_select(0, there.flatten()).reshape(there.shape)


def _offsets(width: int, key: int, group: tuple[int, int], device: torch.device) -> Tensor:
    """Differences of pixel numbers from each pixel of a band, row by row, to each other place in its group, int64
    `[.., ROWS_PER_BAND * width]`; out of all films where the band ends before the place."""
    across, down = group if key & 1 else group[::-1]
    right, below = (key >> 8) % across, (key >> 16) % down
    sizes = (across * down, ROWS_PER_BAND, width)
    member, row, x = torch.meshgrid(*(torch.arange(size, device=device) for size in sizes), indexing="ij")
    column = ((x + right) ^ (member % across)) - right
    line = ((row + below) ^ (member // across)) - below
    inside = (column < width) & (column // COLUMNS == x // COLUMNS) & (line >= 0) & (line < ROWS_PER_BAND)
    return torch.where(inside, (line - row) * width + column - x, -(1 << 40))[1:].flatten(1)


def _repeated(values: Tensor, times: int) -> Tensor:
    """Values `[.., N]` so many times, `[.., times N]`; as they are for once."""
    return values if times == 1 else values.repeat(*[1] * (values.ndim - 1), times)


def _passing(lens: Lens, points: Tensor, focus: Tensor) -> Tensor:
    """W / A at lens points `[2, N]` towards focus points `[3, N]`, `[N]`."""
    return lens.transmission(points) * lens.unblocked(points, focus) / lens.area


@kernel
def _reconnected(points: Tensor, focus: Tensor, other: Tensor, depth: Tensor, plane: Tensor) -> tuple[Tensor, Tensor]:
    """Lens points `[2, N]` that see the hits of `points` and `focus` through `other` focus points; the Jacobian `[N]`."""
    through = reconnect(points, (other - focus)[:2], depth, focus[2])
    return through, reconnection_jacobian(plane, points, through)


@kernel
def _ray_to(through: Tensor, position: Tensor, normal: Tensor, offset: Tensor) -> tuple[Tensor, ...]:
    """Unit directions from surfaces to points `[3, N]`, whether they lie on the normal's side, and rays off the surface."""
    offset_to = through - position
    outgoing = offset_to / length(offset_to)
    origin = position + normal * offset
    ray = through - origin
    distance = length(ray)
    return outgoing, dot(normal, outgoing) > 0.0, origin, ray / distance, distance * (1.0 - 1e-4)
