"""Unidirectional path tracer with next-event estimation and MIS: the radiance along batches of rays."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from bokehguide.render import dimensions
from bokehguide.render.bsdf.dielectric import DELTA_PDF
from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.geometry import Geometry
from bokehguide.render.light_groups import GroupedLights, GroupRadiance
from bokehguide.render.lights.base import LightSampler
from bokehguide.render.lights.power_sampler import PowerLightSampler
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.render.native import CoreRays, NativeTracer
from bokehguide.render.observer import PathObserver, PrimaryHitAOVs
from bokehguide.render.paths import Paths, Rays
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.render.random import PixelRandom
from bokehguide.render.shadow_roulette import MIRROR_PDF, roulette_factor
from bokehguide.render.splitting import UNSPLIT, Splitting
from bokehguide.render.surface import Surface
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.vector import divisor, dot, length
from bokehguide.render.visibility import Arrivals, Visibility
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.emitters import Emitters, find_emitters
from bokehguide.scene.types import Scene

log = logging.getLogger(__name__)

ROULETTE_DEPTH = 4
"""Least number of segments of a path before Russian roulette. Earlier roulette would add noise: a dark diffuse surface would end
most paths, and a survivor that finds an emitter in a mirror would have a large weight."""
MAX_SURVIVAL = 0.95
"""Largest probability of surviving Russian roulette."""
SHADOW_END = 1.0 - 1e-4
"""Length of a shadow ray over the distance of the light, so that the surface of the light does not block the ray."""


@dataclass
class PathSamples:
    """Radiance along N rays, and their primary hits.

    All tensors except `triangle` are float32. radiance: `[3, N]`. distance: to the primary hit, `[N]`, MISS_DISTANCE without a
    hit. normal, albedo, emission: of the primary hit, `[3, N]`. alpha: `[N]`; 1 if the camera sees a surface or an environment
    map, else the alpha of distant lights. triangle: of the primary hit, int32 `[N]`, -1 without a hit. rays: number of traced
    rays. primary_hits: record of the primary hits if paths split and a ray met a surface, else None. groups: radiance of the
    light groups, None if it was not asked for.
    """

    radiance: Tensor
    distance: Tensor
    normal: Tensor
    albedo: Tensor
    emission: Tensor
    alpha: Tensor
    triangle: Tensor
    rays: int
    primary_hits: PrimaryHits | None
    groups: GroupRadiance | None = None

    def of_group(self, group: int) -> PathSamples:
        """The same samples with the light of one group alone."""
        assert self.groups is not None
        hits = self.primary_hits and self.groups.hits(self.primary_hits, group)
        return replace(self, radiance=self.groups.rays[group], primary_hits=hits)


class PathTracer:
    """Computes the radiance along batches of rays. Threads may call `trace` concurrently.

    light_sampler: light sampler of all vertices; a trace may have another light sampler for primary hits. max_depth: largest
    number of segments of a path; with 1, the camera sees only emission.

    geometry: of another tracer whose scene differs in its lights at infinity alone, to be used again. threads: number of threads
    on which Embree traces the rays of one call of `trace`.
    """

    def __init__(self, scene: Scene, device: torch.device | str = "cpu", geometry: Geometry | None = None, threads: int = 1):
        self._scene = scene
        self.geometry = geometry or Geometry(scene, device, threads)
        self.lights = Lights(scene, self.geometry)
        self.light_sampler = PowerLightSampler(self.lights)
        self.visibility = Visibility(self.geometry, scene.meshes)
        self.max_depth = scene.film.max_depth
        self.native = NativeTracer.make(self.geometry, self.lights, self.visibility)
        """The native core for this scene, None where it is missing."""

    @cached_property
    def emitters(self) -> Emitters:
        """The emitters of the scene, found when they are first needed."""
        log.info("finding the emitters")
        return find_emitters(self._scene)

    def trace(
        self,
        origin: Tensor,
        direction: Tensor,
        random: PixelRandom,
        timer: PhaseTimer,
        *,
        max_depth: int | None = None,
        alive: Tensor | None = None,
        light_sampler: LightSampler | None = None,
        splitting: Splitting = UNSPLIT,
        observers: Sequence[PathObserver] = (),
        groups: GroupedLights | None = None,
        shadow_threshold: Tensor | None = None,
    ) -> PathSamples:
        """Trace rays with world origins and unit directions `[3, N]`.

        max_depth: largest number of segments in this trace. alive: positive for rays to trace, `[N]`, None for all; all other
        rays are misses. light_sampler: light sampler at primary hits. splitting: strategy of splitting at primary hits.
        observers: the trace calls their methods. groups: light groups whose radiance the trace is to give.
        shadow_threshold: light samples that add less to a ray play roulette before their shadow ray (`shadow_roulette.py`),
        largest channel of the radiance along the ray, `[N]`; None for no roulette.
        """
        sampler, max_depth = light_sampler or self.light_sampler, max_depth or self.max_depth
        by_group = None if groups is None else GroupRadiance.empty(groups, origin.shape[1], origin.device)
        if self.native is not None and self.native.knows(sampler, splitting, *observers):
            given = CoreRays(origin, direction, alive, random, max_depth, shadow_threshold)
            fields = self.native.trace(given, sampler, splitting, observers, timer, by_group)
            return PathSamples(**fields, primary_hits=splitting.primary_hits, groups=by_group)
        aovs = PrimaryHitAOVs(origin.shape[1], origin.device)
        observers = (*observers, by_group) if by_group is not None else observers
        trace = _Trace(self, sampler, splitting, (aovs, *observers), timer)
        radiance = trace.run(origin, direction, alive, random, max_depth, shadow_threshold)
        samples = PathSamples(radiance, **vars(aovs), rays=trace.rays, primary_hits=splitting.primary_hits, groups=by_group)
        for observer in observers:
            observer.finished(radiance, samples.distance)
        return samples


@dataclass
class _Trace:
    """One call of `PathTracer.trace`; rays: number of rays traced so far."""

    tracer: PathTracer
    light_sampler: LightSampler
    splitting: Splitting
    observers: tuple[PathObserver, ...]
    timer: PhaseTimer
    rays: int = 0

    def run(
        self,
        origin: Tensor,
        direction: Tensor,
        alive: Tensor | None,
        random: PixelRandom,
        max_depth: int,
        shadow_threshold: Tensor | None,
    ) -> Tensor:
        """Radiance `[3, N]` along the rays."""
        radiance, index = torch.zeros_like(origin), torch.arange(origin.shape[1], device=origin.device)
        pdf = torch.full(index.shape, DELTA_PDF, device=origin.device)
        rays: Rays | None = Rays(origin, origin, direction, pdf, alive)
        lights = self.tracer.light_sampler.at(origin)
        start = torch.ones_like(origin), torch.zeros_like(origin)
        paths = Paths(radiance, index, *start, random, lights, shadow_threshold)
        for depth in range(1, max_depth + 1):
            segment = _PrimarySegment(self, depth) if depth == 1 else _Segment(self, depth)
            paths, rays = segment.extend(paths, rays, depth == max_depth)
            if rays is None:
                break
        self.splitting.collect(radiance)
        return radiance


class _Segment:
    """The segments with the number `depth` of a trace. Rays go to the next surfaces, emission arrives, and paths scatter."""

    def __init__(self, trace: _Trace, depth: int):
        self._trace, self._tracer, self._depth = trace, trace.tracer, depth
        self._observers = trace.observers

    def extend(self, paths: Paths, rays: Rays, last: bool) -> tuple[Paths, Rays | None]:
        """Add the arriving light; returns the continuing paths and their rays, None for no rays, as after the `last` segment."""
        found = self._nearest(paths, rays)
        if len(found.ended) > 0:
            paths.end(found.ended)
        if len(found.missed) > 0:
            escaped = paths.select(found.missed)
            self._add_environment(escaped, rays.select(found.missed))
            escaped.finish()
        if len(found.hit.triangle) == 0:
            return paths, None
        paths, surface = self._meet(paths, rays, found)
        if last:
            paths.finish()
            return paths, None
        paths, surface = self._begin_vertex(paths, found, surface)
        return paths, self._scatter(paths, surface)

    def _nearest(self, paths: Paths, rays: Rays, counts: Tensor | None = None) -> Arrivals:
        crossing = dimensions.crossing(self._depth)
        ray = rays.origin, rays.direction, paths.random
        found, traced = self._tracer.visibility.nearest(*ray, crossing, self._trace.timer, rays.alive, counts)
        self._trace.rays += traced
        return found

    def _add_environment(self, paths: Paths, rays: Rays) -> None:
        """Add the radiance of the environment to paths that left the scene, with the MIS weight against light sampling."""
        environment = self._tracer.lights.environment
        if environment is not None:
            weights = paths.lights.environment_weights(rays.vertex, rays.direction, rays.pdf)
            light = paths.throughput * environment.radiance(rays.direction)
            arrived = light * weights.weight
            paths.radiance += arrived
            for observer in self._observers:
                observer.arrival(paths.index, torch.full_like(weights.weight, MISS_DISTANCE), arrived)
                observer.emitter(paths.index, arrived, None, rays.direction)
                if weights.broad is not None:
                    observer.broad_light(paths.index, light * weights.broad)

    def _meet(self, paths: Paths, rays: Rays, found: Arrivals) -> tuple[Paths, Surface]:
        """Paths that met surfaces, and the surfaces. The emission of the surfaces is added to the paths."""
        geometry, origin, direction = self._tracer.geometry, rays.origin, rays.direction
        if found.met is not None:
            paths, origin, direction = (
                paths.select(found.met),
                origin.index_select(1, found.met),
                direction.index_select(1, found.met),
            )
        surface = geometry.surface(origin, direction, found.hit)
        transmittance = geometry.transmittance(found.hit, surface.front)
        if transmittance is not None:
            paths.throughput *= transmittance
        if len(found.emitters) > 0:
            self._add_emission(paths, rays, found, surface)
        return paths, surface

    def _emission(self, paths: Paths, found: Arrivals, surface: Surface) -> tuple[Hit, Tensor]:
        """Emitters that rays met, and throughput of the paths times radiance of the emitters, `[3, K]`."""
        index = found.emitters
        emitter = Hit(*(values.index_select(0, index) for values in found.hit))
        outgoing = surface.outgoing.index_select(1, index)
        radiance = self._tracer.geometry.emission(emitter, surface.front.index_select(0, index), outgoing)
        return emitter, paths.throughput.index_select(1, index) * radiance

    def _add_emission(self, paths: Paths, rays: Rays, found: Arrivals, surface: Surface) -> None:
        """Add the radiance of emitters that rays met, with the MIS weight against light sampling."""
        index = found.emitters
        emitter, emission = self._emission(paths, found, surface)
        rays = rays.select(index if found.met is None else found.met.index_select(0, index))
        # Light samples start at the vertex. Rays start at an offset from the surface.
        offset = surface.position.index_select(1, index) - rays.vertex
        distance = length(offset)
        cosine = dot(surface.geometric_normal.index_select(1, index), offset) / divisor(distance)
        lights = paths.lights.select(index)
        weights = lights.triangle_weights(rays.vertex, emitter.triangle, distance, cosine, rays.pdf)
        arrived, place = emission * weights.weight, paths.index.index_select(0, index)
        paths.radiance.index_add_(1, index, arrived)
        for observer in self._observers:
            observer.arrival(place, distance, arrived)
            observer.emitter(place, arrived, emitter.triangle, rays.direction)
            if weights.broad is not None:
                observer.broad_light(place, emission * weights.broad)

    def _begin_vertex(self, paths: Paths, found: Arrivals, surface: Surface) -> tuple[Paths, Surface]:
        """Paths that scatter, with the distributions of their light samples, and the surfaces of their vertices."""
        paths.lights = self._tracer.light_sampler.at(surface.position)
        for observer in self._observers:
            observer.vertex(paths.index, found.hit, surface, None)
        return paths, surface

    def _scatter(self, paths: Paths, surface: Surface) -> Rays:
        """Sample lights and the BSDF; from ROULETTE_DEPTH on, play Russian roulette."""
        draw, first = self._uniforms(paths), dimensions.vertex(self._depth)
        part = draw(first + dimensions.PART, 1)[0] if self._tracer.geometry.materials.has_transmission else None
        scattering = Scattering(surface, part, paths.throughput)
        if not self._tracer.lights.empty:
            self._sample_light(paths, surface, scattering, draw(first + dimensions.LIGHT, dimensions.LIGHT_COUNT))
        uniforms = draw(first + dimensions.SCATTER, dimensions.SCATTER_COUNT)
        direction, weight, pdf = scattering.sample(dimensions.bsdf_numbers(uniforms))
        for observer in self._observers:
            observer.scattered(direction, pdf)
        roulette = uniforms[0] if self._depth >= ROULETTE_DEPTH else None
        origin, paths.throughput, survival = _next_segment(surface, paths.throughput, direction, weight, roulette)
        return Rays(surface.position, origin, direction, pdf, survival)

    def _uniforms(self, paths: Paths) -> Callable[[int, int], Tensor]:
        """Source of random numbers `[count, N]` by first dimension and count."""
        return paths.random.uniform

    def _sample_light(self, paths: Paths, surface: Surface, scattering: Scattering, uniforms: Tensor) -> None:
        """Next-event estimation with one light sample and one shadow ray for each path."""
        light = paths.lights.sample(surface, scattering, uniforms, paths.random)
        ray = _shadow_ray(surface, paths.throughput, light.direction, light.distance, light.value)
        contribution, brightest, origin, direction, distance = ray
        if paths.shadow_threshold is not None:
            number = paths.random.uniform(dimensions.vertex(self._depth) + dimensions.SHADOW, 1)[0]
            factor = roulette_factor(brightest, paths.shadow_threshold, number)
            factor = torch.where(light.bsdf_pdf <= MIRROR_PDF, factor, 1.0)
            light, contribution, brightest = light.thinned(factor), contribution * factor, brightest * factor
        visibility, traced = self._tracer.visibility.transmittance(origin, direction, distance, brightest, self._trace.timer)
        self._trace.rays += traced
        contribution *= visibility
        self._add_direct(paths, light.direction, contribution)
        for observer in self._observers:
            observer.light_sample(paths.index, light, contribution, visibility)

    def _add_direct(self, paths: Paths, direction: Tensor, contribution: Tensor) -> None:
        paths.radiance += contribution


class _PrimarySegment(_Segment):
    """Segments from the camera, without MIS, because no other technique samples them. Numbers are stratified. Paths may split."""

    def _nearest(self, paths: Paths, rays: Rays, counts: Tensor | None = None) -> Arrivals:
        return super()._nearest(paths, rays, self._trace.splitting.counts)

    def _add_environment(self, paths: Paths, rays: Rays) -> None:
        environment = self._tracer.lights.environment
        if environment is not None and environment.visible:
            seen = paths.throughput * environment.radiance(rays.direction)
            paths.radiance += seen
            alpha = environment.alpha(rays.direction)
            for observer in self._observers:
                observer.primary_escape(paths.index, alpha)
                observer.emitter(paths.index, seen, None, rays.direction)

    def _meet(self, paths: Paths, rays: Rays, found: Arrivals) -> tuple[Paths, Surface]:
        paths, surface = super()._meet(paths, rays, found)
        for observer in self._observers:
            observer.primary_hit(paths.index, found.hit, surface, paths.radiance)
        return paths, surface

    def _add_emission(self, paths: Paths, rays: Rays, found: Arrivals, surface: Surface) -> None:
        index = found.emitters
        emitter, emission = self._emission(paths, found, surface)
        paths.radiance.index_add_(1, index, emission)
        direction = -surface.outgoing.index_select(1, index)
        for observer in self._observers:
            observer.emitter(paths.index.index_select(0, index), emission, emitter.triangle, direction)

    def _begin_vertex(self, paths: Paths, found: Arrivals, surface: Surface) -> tuple[Paths, Surface]:
        paths.lights = self._trace.light_sampler.at(surface.position)
        split = self._trace.splitting.split(self._tracer.geometry, paths, found, surface, self._observers)
        paths, surface, owner = split
        for observer in self._observers:
            observer.vertex(paths.index, found.hit, surface, owner)
        return paths, surface

    def _uniforms(self, paths: Paths) -> Callable[[int, int], Tensor]:
        return partial(paths.random.stratified, first=paths.lights.first_step)

    def _add_direct(self, paths: Paths, direction: Tensor, contribution: Tensor) -> None:
        self._trace.splitting.add_direct(paths, direction, contribution)

    def _scatter(self, paths: Paths, surface: Surface) -> Rays:
        rays = super()._scatter(paths, surface)
        self._trace.splitting.scattered(rays.direction)
        return rays


def _shadow_ray(surface: Surface, throughput: Tensor, direction: Tensor, distance: Tensor, value: Tensor) -> tuple[Tensor, ...]:
    """Unshadowed contributions `[3, N]` of light samples, their largest channels, and origins, directions and lengths of shadow
    rays.

    A shadow ray starts at an offset from the surface and ends at the sampled point. The ray therefore does not miss a close
    emitter.
    """
    contribution = throughput * value
    origin = surface.leave(direction)
    target = direction - (origin - surface.position) / distance
    stretch = length(target)
    return contribution, contribution.amax(0), origin, target / stretch, distance * stretch * SHADOW_END


def _next_segment(
    surface: Surface, throughput: Tensor, direction: Tensor, weight: Tensor, uniform: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Origins and throughputs `[3, N]` of the next segments, and a number `[N]` that is positive for continuing paths.

    uniform: uniform numbers `[N]` for Russian roulette, None without Russian roulette.
    """
    throughput = throughput * weight
    survival = throughput.amax(0)
    if uniform is not None:
        chance = survival.clamp(max=MAX_SURVIVAL)
        survival = chance * (uniform < chance)
        throughput = throughput / divisor(chance, 1e-20)
    return surface.leave(direction), throughput, survival
