"""Reuse of primary hits among neighbouring pixels: each pixel of a group also uses the hits of the other pixels.

Many pixels see the same point out of focus. A pixel therefore uses the paths from the primary hits of the other pixels in its
group (Bekaert, Sbert and Halton 2002). The pixel sees such a hit through another lens point: the lens point on the line from the
hit through the pixel's own focus point. This is the reconnection of Area ReSTIR (`models/reconnection.py`). A shadow ray tests
whether a surface blocks the line.

Multiple importance sampling with the balance heuristic combines the hits. Pixel k finds a point x with the density
p_k = q_k |∂l_k / ∂x|. In pixel i, the weight of emission at x is W V_i |∂l_i / ∂x| / (A Σ_k V_k p_k), where V_k is the visibility
between x and the lens point of pixel k. Light that x reflects comes from a direction ω, drawn as pixel s sees x. Its weight is
W V_i |∂l_i / ∂x| f_s / (A Σ_k V_k p_k f_k), where f_k is the luminance of the BSDF for ω as pixel k sees x. On a glossy surface,
the pixels therefore do not use directions that are rare for s but frequent for i with a large weight.
Only one pixel sees a point in focus, and the weight of this point is W / (A q). At a silhouette,
the shading normal of x may face one pixel, and another normal may replace it for a second pixel. The pixels then do not see the
same surface, and V is 0.

The pixels of a tile of the film form two groups (`PixelGroups`). The positions of tiles change with every step. In a picture of
few samples, compact groups would show as blocks. The groups of the first SCATTERED_STEPS steps are therefore scattered, in a
pattern like a chessboard. The groups of later steps are compact, because near pixels see more of each other's hits. No
group crosses the end of a band of rows or columns, so that ranks, batches and blocks of adaptive SPP contain whole groups. The
noise of the pixels of a group is correlated, and a denoiser removes less of correlated noise. A render with a denoiser therefore
has groups of its own (`GuidedConfig.denoised_reuse_group`), by default of one pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.control_variate import CELL, ControlVariate, NoControlVariate
from bokehguide.guiding.cross_fitting import cross_fitted
from bokehguide.guiding.native_reuse import PixelGroups, Reused, ViewPoints, native_reuse
from bokehguide.guiding.protocols import BatchSamples, ModeContext, SampleReuse, StepSummary
from bokehguide.models.reconnection import reconnect, reconnection_jacobian
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import FilmSamples
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.render.random import hash_int
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import dot, length, luminance
from bokehguide.runtime.device import to_device
from bokehguide.runtime.distributed import ROWS_PER_BAND
from bokehguide.runtime.indexing import ActiveEntries, Pixels, indices, pixel_numbers, scatter
from bokehguide.runtime.timer import PhaseTimer

COLUMNS = 32
"""Number of columns in a band. Groups end at the end of a band."""
SCATTERED_STEPS = 8
"""Number of steps with scattered groups."""
GROUP_SPACING = 3.0
"""Approximate mean distance between two pixels of a group, in pixels."""
PAIRS_AT_ONCE = 65536
"""Approximate number of pixel pairs in one operation on a CPU. More pairs exceed the cache; fewer have more Python overhead."""
INFINITE = 1e30
"""Depth of hits at infinity."""


class _Hits(NamedTuple):
    """The primary hits of a batch, camera frame.

    plane: of the surface, `[3, N]` (see `Reservoirs`). depth: `[N]`. reusable: whether other pixels may use the hit, bool `[N]`.
    place: index of the sample in `PrimaryHits`, int64 `[N]`, -1 for none.
    """

    plane: Tensor
    depth: Tensor
    reusable: Tensor
    place: Tensor


class _Views(NamedTuple):
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


class _SeenPaths(NamedTuple):
    """Q paths of the hits on surfaces of a row of views. view: index into the views; path: of the primary hits, int64 `[Q]` each.
    bsdf: towards the lens points of the views, for the two directions of a path, `[3, Q]` each."""

    view: Tensor
    path: Tensor
    bsdf: tuple[Tensor, Tensor]

    @classmethod
    def of(cls, views: _Views, hits: _Hits, primary: PrimaryHits | None) -> _SeenPaths | None:
        """The paths of `views`; None without any."""
        if primary is None or len(views.on_surface) == 0:
            return None
        place = hits.place.index_select(0, views.source.index_select(0, views.on_surface))
        index, path = primary.paths_of(place, views.path_count)
        view = views.on_surface.index_select(0, index)
        return cls(view, path, primary.bsdf(path, views.outgoing.index_select(1, view)))


class _Weights(NamedTuple):
    """Weights of the samples of N pixels with P paths. scale: 1 / Σ_k V_k p_k, `[N]`. passing: W V / A at each pixel's own lens
    point, `[N]`. factors: f_s / Σ_k V_k p_k f_k, `[P]`, for the two directions of a path."""

    scale: Tensor
    passing: Tensor
    factors: list[Tensor]

    @property
    def of_own(self) -> Tensor:
        """Weight `[N]` of the lens point of each pixel's own sample."""
        return self.passing * self.scale


class _Densities(NamedTuple):
    """Σ_k V_k p_k for each of N hits, `of_lens`, and Σ_k V_k p_k f_k for the two directions of each of P paths, `of_directions`.
    bsdf: f_s, `[P]` for each direction."""

    of_lens: Tensor
    of_directions: list[Tensor]
    bsdf: list[Tensor]

    @classmethod
    def of_own(cls, own: dict[str, Tensor], hits: PrimaryHits | None) -> _Densities:
        """The summands of the pixels' own lens points."""
        of_lens = own["density"] * own.get("transmittance", 1.0)
        if hits is None:
            return cls(of_lens, [], [])
        bsdf = [luminance(value) for value in hits.reflection[0]]
        return cls(of_lens, [of_lens.index_select(0, hits.path_rays) * value for value in bsdf], bsdf)

    def add(self, density: Tensor, views: _Views, seen: _SeenPaths | None) -> None:
        """Add views with `density` `[J]`."""
        self.of_lens.index_add_(0, views.source, density)
        if seen is not None:
            for sums, value in zip(self.of_directions, seen.bsdf):
                sums.index_add_(0, seen.path, density.index_select(0, seen.view) * luminance(value))

    def weights(self, passing: Tensor) -> _Weights:
        """passing: see `_Weights`."""
        scale = torch.where(self.of_lens > 0.0, 1.0 / self.of_lens, 0.0)
        factors = [torch.where(sums > 0.0, value / sums, 0.0) for value, sums in zip(self.bsdf, self.of_directions)]
        return _Weights(scale, passing, factors)


class _LensRays(NamedTuple):
    """Rays from hits to lens points.

    outgoing: unit directions of the light, world frame, `[3, J]`. origin, direction: of the rays, world frame, `[3, J]`.
    distance: length of the rays, `[J]`, MISS_DISTANCE for hits at infinity. path_counts: number of paths of the hit, 0 if the
    lens point is below the surface, `[J]`.
    """

    outgoing: Tensor
    origin: Tensor
    direction: Tensor
    distance: Tensor
    path_counts: Tensor


class PixelPathReuse:
    """Reuses primary hits among the pixels of a film. Threads may call `reuse` concurrently, with batches of whole groups.

    width: of the film, pixels. seed: of the positions of groups. group: number of pixels of a group. min_spread: see
    `GuidedConfig`.
    """

    def __init__(
        self,
        camera: ThinLensCamera,
        tracer: PathTracer,
        width: int,
        seed: int,
        group: int = GuidedConfig.reuse_group,
        min_spread: float = GuidedConfig.min_spread,
    ):
        self._camera, self._tracer, self._width, self._seed = camera, tracer, width, seed
        self._group, self._min_spread = group, min_spread

    def reuse(self, samples: BatchSamples, timer: PhaseTimer) -> Reused:
        """Reuse the samples of one batch, and add the number of shadow rays to `paths.rays`.

        Samples that are not finite are not reused, and stay in their pixel.
        """
        drawn, batch = samples.drawn, samples.batch
        own = {"density": samples.query.own_pdf(drawn)} | self._own_transmittance(samples, timer)
        groups, native = self.groups(batch.step), self._tracer.native
        found = None
        if native is not None:
            found = native_reuse(native, self._camera, groups, self._min_spread, samples, own, timer)
        return self._reuse(groups, samples, own, timer) if found is None else found

    def groups(self, step: int) -> PixelGroups:
        """Groups of a step."""
        key = hash_int(hash_int(self._seed ^ 0x68E31DA4) + step)
        return PixelGroups.of(self._width, self._group, key, step <= SCATTERED_STEPS)

    def _reuse(self, groups: PixelGroups, samples: BatchSamples, own: dict[str, Tensor], timer: PhaseTimer) -> Reused:
        paths, hits, rows = samples.paths, self._hits(samples), []
        sums = _Densities.of_own(own, paths.primary_hits)
        members = _members(samples.batch.places, groups, sums.of_lens.device)
        together = max(1, PAIRS_AT_ONCE // members.shape[1]) if members.device.type == "cpu" else len(members)
        for viewers in members.split(together) if len(members) > 0 else ():
            views = self._views(viewers, hits, samples, timer)
            if len(views.source) > 0:
                density = ViewPoints(views.viewer, views.points, views.ends).densities(samples.query, members.shape[1])
                rows.append((views, _SeenPaths.of(views, hits, paths.primary_hits)))
                sums.add(density * views.jacobian, *rows[-1])
        passing = self._camera.lens.passing(samples.drawn.points, samples.batch.focus) * own.get("transmittance", 1.0)
        weights = sums.weights(torch.where(samples.drawn.weight > 0.0, passing, 0.0))
        by_group = [] if paths.groups is None else [paths.of_group(group) for group in range(len(paths.groups.rays))]
        reused = Reused(_own_radiance(paths, weights), weights.of_own, None)
        if by_group:
            reused = reused._replace(light_groups=torch.stack([_own_radiance(light, weights) for light in by_group]))
        for views, seen in rows:
            weight = (views.passing * views.jacobian * weights.scale.index_select(0, views.source)).nan_to_num(0.0, 0.0, 0.0)
            light = _seen_radiance(views, seen, hits, paths, weight, weights)
            reused.radiance.index_add_(1, views.viewer, light.nan_to_num(0.0, 0.0, 0.0))
            reused.weight.index_add_(0, views.viewer, weight)
            for of_group, radiance in zip(by_group, () if reused.light_groups is None else reused.light_groups):
                part = torch.where(light.isfinite(), _seen_radiance(views, seen, hits, of_group, weight, weights), 0.0)
                radiance.index_add_(1, views.viewer, part.nan_to_num(0.0, 0.0, 0.0))
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
        """Approximate angle `[N]`, radians, at points of `depth` `[N]` between the lens points of two pixels of a group."""
        camera, focus = self._camera, self._camera.lens.focus_distance
        spacing = GROUP_SPACING * camera.pixel_slope * focus * depth / (depth - focus).abs().clamp(min=1e-9)
        return spacing.clamp(max=2.0 * camera.lens.radius) / depth

    def _looks_alike(self, hits: PrimaryHits, least: Tensor) -> Tensor:
        """Whether the paths of a primary hit are good samples for all lens points of a group, bool `[K]`.

        This holds for opaque surfaces with a roughness α of at least `least`. In a smoother surface, another pixel sees another
        reflection.
        """
        surface, materials = hits.surface, self._tracer.geometry.materials
        alike = (surface.alpha >= least) & (surface.facing > 0.0)
        if surface.clearcoat is not None and surface.clearcoat_alpha is not None:
            alike &= (surface.clearcoat <= 0.0) | (surface.clearcoat_alpha >= least)
        if materials.has_transmission:
            alike &= surface.transmission <= 0.0
        if materials.absorbs:  # the absorption depends on the length of the path
            alike &= surface.front > 0.0
        return alike

    def _own_transmittance(self, samples: BatchSamples, timer: PhaseTimer) -> dict[str, Tensor]:
        """Transmittance `[N]` of the translucent surfaces between each pixel's own lens point and primary hit, if it matters."""
        if not self._tracer.geometry.materials.has_translucent or self._group == 1:
            return {}
        hits = self._hits(samples)
        rays = self._lens_rays(hits.place, samples.drawn.points, samples.batch.focus, samples.paths.primary_hits)
        counts = rays.path_counts * hits.reusable
        transmittance, traced = self._tracer.visibility.transmittance(rays.origin, rays.direction, rays.distance, counts, timer)
        samples.paths.rays += traced
        return {"transmittance": torch.where(hits.reusable, transmittance, 1.0)}

    def _views(self, viewers: Tensor, hits: _Hits, samples: BatchSamples, timer: PhaseTimer) -> _Views:
        """The views of all N hits by R rows of other pixels; viewers: int64 `[R, N]`, -1 for no viewer."""
        rows, count = viewers.shape
        viewer = viewers.flatten()
        focus_of_viewer = samples.batch.focus.index_select(1, viewer.clamp(min=0))
        own = (samples.drawn.points, samples.batch.focus, hits.depth, hits.plane, hits.reusable)
        points, focus, depth, plane, reusable = (_repeated(values, rows) for values in own)
        through, jacobian = _reconnected(points, focus, focus_of_viewer, depth, plane)
        passing = self._camera.lens.passing(through, focus_of_viewer) * reusable * (viewer >= 0)
        index = ActiveEntries(passing > 0.0).index
        source = torch.arange(count, device=index.device).repeat(rows)
        place = hits.place.index_select(0, source.index_select(0, index))
        points, focus = through.index_select(1, index), focus_of_viewer.index_select(1, index)
        rays = self._lens_rays(place, points, focus, samples.paths.primary_hits)
        counts = rays.path_counts * (passing.index_select(0, index) > 0.0)
        arriving, traced = self._tracer.visibility.visible_rays(rays.origin, rays.direction, rays.distance, counts, timer)
        samples.paths.rays += traced
        # The host stores which rays arrive, and therefore has the sizes of all later arrays.
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
        """Rays to lens points `[2, J]` from the primary hits at `place` `[J]`, or from infinity where `place` is -1.

        focus: focus points, `[3, J]`.
        """
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
    """The sample reuse of the mode `guided`: `PixelPathReuse`, and the weights as a control variate for the radiance."""

    learns = True
    weighted = True
    roulette_cell = CELL

    def __init__(self, context: ModeContext, config: GuidedConfig):
        super().__init__()
        settings = context.settings
        group = config.denoised_reuse_group if settings.denoise else config.reuse_group
        self.paths = PixelPathReuse(context.camera, context.tracer, context.film_width, settings.seed, group, config.min_spread)
        # With a vignetting lens, the mean weight is unknown.
        known = config.control_variate and not context.camera.lens.vignettes
        shrinkage = config.control_shrinkage if group > 1 else config.unshared_control_shrinkage
        self.control_variate = ControlVariate(context, shrinkage) if known else NoControlVariate()
        self._cross_fits = known and group > 1

    def cuts(self, width: int, height: int) -> np.ndarray:
        return np.append(np.arange(0, width * height, ROWS_PER_BAND * width), width * height)

    def expose(self, samples: BatchSamples, film: Callable[[Pixels, FilmSamples], Tensor], timer: PhaseTimer) -> Tensor:
        batch, reused = samples.batch, self.paths.reuse(samples, timer)
        radiance, groups = self._corrected(batch.step, batch.places, reused)
        ones = torch.ones_like(reused.weight)
        return film(batch.places, replace(samples.film, radiance=radiance, radiance_weight=ones, groups=groups))

    def _corrected(self, step: int, places: Pixels, reused: Reused) -> tuple[Tensor, Tensor | None]:
        """Radiance `[3, N]` after the control variate, and that of the light groups, `[G, 3, N]`, None without groups."""
        radiance, groups = self.control_variate.corrected(places, reused.radiance, reused.weight), reused.light_groups
        shares = self.control_variate.shares(places)
        if step == 1 and self._cross_fits:  # no epoch has ended, and all other coefficients are 0
            of_step = self.paths.groups(step)
            coefficient, shares = cross_fitted(places, of_step, reused.radiance, reused.weight, groups)
            radiance = radiance - coefficient * (reused.weight - 1.0)
        return radiance, None if groups is None else groups - shares * (reused.radiance - radiance)

    def update(self, summary: StepSummary) -> None:
        if summary.ends_epoch:
            self.control_variate.update(summary.picture, summary.groups)

    def merge(self) -> None:
        self.control_variate.merge()


def _own_radiance(paths: PathSamples, weights: _Weights) -> Tensor:
    """Radiance `[3, N]` of the samples of the pixels themselves, times its weights."""
    radiance, hits = paths.radiance * weights.of_own, paths.primary_hits
    if hits is not None:
        # Reflected light has the weight of its direction in place of that of the lens point.
        of_lens, passing = (values.index_select(0, hits.path_rays) for values in (weights.scale, weights.passing))
        for value, incident, factor in zip(*hits.reflection, weights.factors):
            radiance.index_add_(1, hits.path_rays, value * incident * (passing * (factor - of_lens)))
    return radiance


def _seen_radiance(
    views: _Views, seen: _SeenPaths | None, hits: _Hits, paths: PathSamples, weight: Tensor, weights: _Weights
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


def _members(places: Pixels, groups: PixelGroups, device: torch.device) -> Tensor:
    """The other pixels in the groups of N pixels, as indices into the N pixels, int64 `[members - 1, N]`; -1 for no pixel.

    places: pixels of the film.
    """
    numbers = pixel_numbers(places, device)
    first, last = (places.start, places.stop - 1) if isinstance(places, slice) else (int(places[0]), int(places[-1]))
    among = torch.full((last - first + 2,), -1, device=device)  # the last entry is shared by all other places
    among[numbers - first] = torch.arange(len(numbers), device=device)
    there = numbers - first + _offsets(groups, device).index_select(1, numbers % (ROWS_PER_BAND * groups.width))
    there = torch.where((there >= 0) & (there < len(among)), there, len(among) - 1)
    return among.index_select(0, there.flatten()).reshape(there.shape)


def _offsets(groups: PixelGroups, device: torch.device) -> Tensor:
    """Offsets in pixel numbers from each pixel of a band to the other pixels of its group, int64
    `[members - 1, ROWS_PER_BAND * width]`. If the other pixel is outside the band, the offset leads outside any film."""
    width, (dx, dy) = groups.width, to_device(list(zip(*groups.offsets())), device, torch.int64)[:, :, None, None]
    row, x = torch.meshgrid(*(torch.arange(size, device=device) for size in (ROWS_PER_BAND, width)), indexing="ij")
    column = ((x + groups.right) ^ dx) - groups.right
    line = ((row + groups.below) ^ dy) - groups.below
    inside = (column < width) & (column // COLUMNS == x // COLUMNS) & (line >= 0) & (line < ROWS_PER_BAND)
    return torch.where(inside, (line - row) * width + column - x, -(1 << 40))[1:].flatten(1)


def _repeated(values: Tensor, times: int) -> Tensor:
    """Values `[.., N]` repeated `times` times, `[.., times N]`."""
    return values if times == 1 else values.repeat(*[1] * (values.ndim - 1), times)


def _reconnected(points: Tensor, focus: Tensor, other: Tensor, depth: Tensor, plane: Tensor) -> tuple[Tensor, Tensor]:
    """Reconnected lens points `[2, N]` and Jacobians `[N]`.

    A hit on the ray from `points` through `focus` is also on the ray from its reconnected lens point through `other`.
    """
    through = reconnect(points, (other - focus)[:2], depth, focus[2])
    return through, reconnection_jacobian(plane, points, through)


def _ray_to(through: Tensor, position: Tensor, normal: Tensor, offset: Tensor) -> tuple[Tensor, ...]:
    """Unit directions from surfaces to points `[3, N]`, whether the points are on the normal's side, and rays off the surface."""
    offset_to = through - position
    outgoing = offset_to / length(offset_to)
    origin = position + normal * offset
    ray = through - origin
    distance = length(ray)
    return outgoing, dot(normal, outgoing) > 0.0, origin, ray / distance, distance * (1.0 - 1e-4)
