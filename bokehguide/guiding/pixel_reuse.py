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

`PixelGroups` describes the groups. The noise of the pixels of a group is correlated, and a denoiser removes less of correlated
noise. A render with a denoiser therefore has groups of its own (`GuidedConfig.denoised_reuse_group`), by default of one pixel.
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
from bokehguide.guiding.native_reuse import ViewPoints, native_reuse
from bokehguide.guiding.pixel_groups import SCATTERED_STEPS, PixelGroups
from bokehguide.guiding.protocols import BatchSamples, ModeContext, SampleReuse, StepSummary
from bokehguide.guiding.reuse_weights import Densities, Hits, Reused, SeenPaths, Views, own_radiance, seen_radiance
from bokehguide.models.reconnection import reconnect, reconnection_jacobian
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.epochs import epoch_of
from bokehguide.render.film import FilmSamples
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.render.random import PixelRandom, hash_int
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import dot, length
from bokehguide.runtime.device import to_device
from bokehguide.runtime.distributed import ROWS_PER_BAND
from bokehguide.runtime.indexing import ActiveEntries, Pixels, indices, scatter
from bokehguide.runtime.timer import PhaseTimer

GROUP_SPACING = 3.0
"""Approximate mean distance between two pixels of a group, in pixels."""
PAIRS_AT_ONCE = 65536
"""Approximate number of pixel pairs in one operation on a CPU. More pairs exceed the cache; fewer have more Python overhead."""
INFINITE = 1e30
"""Depth of hits at infinity."""


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

    def __init__(self, camera: ThinLensCamera, tracer: PathTracer, width: int, seed: int, group: int, min_spread: float):
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
        first = epoch_of(step)
        key = hash_int(hash_int(self._seed ^ 0x68E31DA4) + first)
        return PixelGroups.of(self._width, self._group, key, first <= SCATTERED_STEPS)

    def share(self, random: PixelRandom, places: Pixels, step: int) -> PixelRandom | None:
        """See `SampleReuse`: the stratified numbers of a group are parts of one sequence."""
        if self._group == 1:
            return None
        keys, member = self.groups(step).numbered(places, random.pixel_keys.device)
        return random.in_groups(keys, member, self._group)

    def _reuse(self, groups: PixelGroups, samples: BatchSamples, own: dict[str, Tensor], timer: PhaseTimer) -> Reused:
        paths, hits, rows = samples.paths, self._hits(samples), []
        sums = Densities.of_own(own, paths.primary_hits)
        members = groups.members(samples.batch.places, sums.of_lens.device)
        together = max(1, PAIRS_AT_ONCE // members.shape[1]) if members.device.type == "cpu" else len(members)
        for viewers in members.split(together) if len(members) > 0 else ():
            views = self._views(viewers, hits, samples, timer)
            if len(views.source) > 0:
                density = ViewPoints(views.viewer, views.points, views.ends).densities(samples.query, members.shape[1])
                rows.append((views, SeenPaths.of(views, hits, paths.primary_hits)))
                sums.add(density * views.jacobian, *rows[-1])
        passing = self._camera.lens.passing(samples.drawn.points, samples.batch.focus) * own.get("transmittance", 1.0)
        weights = sums.weights(torch.where(samples.drawn.weight > 0.0, passing, 0.0))
        by_group = [] if paths.groups is None else [paths.of_group(group) for group in range(len(paths.groups.rays))]
        radiance, total = own_radiance(paths, weights), weights.of_own
        group_radiances = [own_radiance(of_group, weights) for of_group in by_group]
        for views, seen in rows:
            weight = (views.passing * views.jacobian * weights.scale.index_select(0, views.source)).nan_to_num(0.0, 0.0, 0.0)
            light = seen_radiance(views, seen, hits, paths, weight, weights)
            radiance.index_add_(1, views.viewer, light.nan_to_num(0.0, 0.0, 0.0))
            total.index_add_(0, views.viewer, weight)
            for of_group, group_radiance in zip(by_group, group_radiances):
                part = torch.where(light.isfinite(), seen_radiance(views, seen, hits, of_group, weight, weights), 0.0)
                group_radiance.index_add_(1, views.viewer, part.nan_to_num(0.0, 0.0, 0.0))
        return Reused(radiance, total, torch.stack(group_radiances) if by_group else None)

    def _hits(self, samples: BatchSamples) -> Hits:
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
        return Hits(plane, torch.where(infinite, INFINITE, depth), reusable, place)

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

    def _views(self, viewers: Tensor, hits: Hits, samples: BatchSamples, timer: PhaseTimer) -> Views:
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
        return Views(source, viewer, through, jacobian, passing, outgoing, on_surface, path_count, ends.tolist())

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

    def share(self, random: PixelRandom, places: Pixels, step: int) -> PixelRandom | None:
        return self.paths.share(random, places, step)

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
