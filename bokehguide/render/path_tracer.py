"""The path tracer: unidirectional, with next-event estimation and MIS.

It answers one question, "what radiance arrives along these rays?", and knows nothing of
lenses, films or guiding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render import mis
from bokehguide.render.dielectric import DELTA_PDF
from bokehguide.render.direct_light import direct_light
from bokehguide.render.first_surfaces import FirstSurfaces
from bokehguide.render.geometry import Geometry, Surface
from bokehguide.render.kernels import kernel
from bokehguide.render.light_choice import LightChoice
from bokehguide.render.lights import Lights
from bokehguide.render.opacity import MAX_CROSSINGS, Arrivals, Opacity
from bokehguide.render.pencils import Images, Shown
from bokehguide.render.pixels import increase, put
from bokehguide.render.random import PixelRandom
from bokehguide.render.scattering import Scattering
from bokehguide.render.timer import PhaseTimer
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.vector import dot, length
from bokehguide.scene.types import Scene

ROULETTE_DEPTH = 4
"""Paths of at least this many segments may end by Russian roulette. Not earlier: of the few that go on from dark first surfaces,
each would count many times as much where it finds a lamp in a mirror (docs/results.md, "Light samples, Russian roulette")."""
DIMENSIONS = 16
"""Random dimensions reserved for each segment of a path."""
FIRST_DIMENSION = 32
"""Dimensions below this belong to the camera."""
FIRST_CROSSING = 1 << 20
"""Dimensions from here on choose where segments go through sheer surfaces, MAX_CROSSINGS of them each."""


class LightsChosen(NamedTuple):
    """The light samples under a `LightChoice`, `[K]` each, one for every path that left a first surface.

    row: of the choice; cluster: int32 both, the latter -1 where there was none; worth: the luminance it brought times
    the root of the cluster's probability, whose square is on average the sum over clusters of the squared luminance each
    would have brought; seen: the share of it that nothing blocked.
    """

    row: Tensor
    cluster: Tensor
    worth: Tensor
    seen: Tensor


@dataclass
class PathSamples:
    """What N camera rays brought back, all `[.., N]` and, but for the triangle, float32.

    radiance, and of the first surface normal, albedo and emission: `[3, N]`; distance to it,
    MISS_DISTANCE where there is none; alpha: 1 where the camera sees a surface or what lies
    at infinity, else 0; triangle: that of the first surface, int32, -1 where there is none;
    rays: number of rays traced; first: the first surfaces, where paths split there, None where no ray met one. Under a
    `LightChoice`, also the lights it chose, None where no ray met a surface; and what is shown in mirrors and glass.
    """

    radiance: Tensor
    distance: Tensor
    normal: Tensor
    albedo: Tensor
    emission: Tensor
    alpha: Tensor
    triangle: Tensor
    rays: int = 0
    first: FirstSurfaces | None = None
    lights: LightsChosen | None = None
    shown: Shown | None = None

    @property
    def image(self) -> Tensor | None:
        """Under a `LightChoice`, the distance at which most of the radiance appears to come from: that of the first surface, or of
        what it mirrors or lets through."""
        return None if self.shown is None else self.shown.distances()

    @classmethod
    def empty(cls, count: int, device: torch.device) -> PathSamples:
        """Rays that met nothing."""
        vectors = torch.zeros(4, 3, count, device=device)
        distance = torch.full((count,), MISS_DISTANCE, device=device)
        triangle = torch.full((count,), -1, dtype=torch.int32, device=device)
        return cls(vectors[0], distance, *vectors[1:], torch.zeros(count, device=device), triangle)


class _Rays(NamedTuple):
    """The next segments of paths.

    vertex: where the last scattering was and lights were sampled for; origin: the same, off the surface; pdf: of the direction;
    alive: positive, `[N]`, where paths go on, None where all do. What the others hold means nothing.
    """

    vertex: Tensor
    origin: Tensor
    direction: Tensor
    pdf: Tensor
    alive: Tensor | None = None

    def select(self, index: Tensor) -> _Rays:
        return _Rays(*(values.index_select(-1, index) for values in self[:4]))


@dataclass
class _Paths:
    """Paths that are alive, compacted where their rays end.

    brought: radiance `[3, M]`, to which paths add theirs at `index` when they end. choice: how lights were sampled for them
    last, or will be, where not as everywhere.
    """

    brought: Tensor
    index: Tensor
    throughput: Tensor
    radiance: Tensor
    random: PixelRandom
    choice: LightChoice | None

    def select(self, index: Tensor) -> _Paths:
        values = (values.index_select(-1, index) for values in (self.index, self.throughput, self.radiance))
        return _Paths(self.brought, *values, self.random.select(index), self.choice and self.choice.select(index))

    def split(self, parts: Tensor, count: int) -> tuple[_Paths, Tensor]:
        """Each ends, and becomes `parts`, int64 `[N]`, of equal shares of the throughput, next to one another, `count` in all, which
        bring what they find to places of their own; and which each was, int64 `[M]`. The first of them keeps the random numbers."""
        self.finish()
        owner = torch.repeat_interleave(parts, output_size=count)
        place = torch.arange(len(owner), device=owner.device)
        number = place - (parts.cumsum(0) - parts).index_select(0, owner)
        paths = self.select(owner)
        paths.throughput /= parts.index_select(0, owner)
        paths.radiance = torch.zeros_like(paths.radiance)
        paths.brought, paths.index = torch.zeros_like(paths.radiance), place
        paths.random = paths.random.copies(number)
        return paths, owner

    def finish(self) -> None:
        """Add the radiance of all of them to what paths brought."""
        increase(self.brought, self.index, self.radiance)

    def end(self, ended: Tensor) -> None:
        """Add the radiance of those at `ended`, int64 `[K]`, that do not go on."""
        unknown = 0.0 * self.throughput.index_select(1, ended)  # a NaN is the film's to report
        increase(self.brought, self.index.index_select(0, ended), self.radiance.index_select(1, ended) + unknown)


class PathTracer:
    """Radiance along batches of rays. Threads may call `trace` side by side.

    max_depth: longest path in segments; 1 is emission seen directly.
    """

    def __init__(self, scene: Scene, device: torch.device | str = "cpu"):
        self.geometry = Geometry(scene, device)
        self.lights = Lights(scene, self.geometry)
        self.opacity = Opacity(self.geometry, scene.meshes)
        self.max_depth = scene.film.max_depth

    def trace(
        self,
        origin: Tensor,
        direction: Tensor,
        random: PixelRandom,
        timer: PhaseTimer,
        max_depth: int | None = None,
        choose: Callable[[Tensor], LightChoice] | None = None,
        alive: Tensor | None = None,
        parts: Tensor | None = None,
        bright: float = 0.0,
    ) -> PathSamples:
        """Trace rays with world origins and unit directions `[3, N]`; one path a ray, of max_depth segments if given.

        choose: how lights are chosen at first surfaces, by their positions `[3, N]`. alive: positive, `[N]`, for the rays to be
        traced, if not all are; the others meet nothing. parts: into how many paths each splits at its first surface (Arvo and
        Kirk 1990), whole numbers `[N]`, at least 1. bright: luminance from which on it matters where light appears to come from.
        """
        result = PathSamples.empty(origin.shape[1], origin.device)
        images = None if choose is None else Images(self.geometry, origin.shape[1])
        index = torch.arange(origin.shape[1], device=origin.device)
        pdf = torch.full(index.shape, DELTA_PDF, device=origin.device)
        rays = _Rays(origin, origin, direction, pdf, alive)
        paths = _Paths(result.radiance, index, torch.ones_like(origin), torch.zeros_like(origin), random, None)
        last = max_depth or self.max_depth
        for depth in range(1, last + 1):
            first = (choose, parts) if depth == 1 else (None, None)
            paths, rays = self._segment(paths, rays, depth, depth == last, *first, images, result, timer)
            if rays is None:
                break
        if result.first is not None:
            increase(result.radiance, result.first.rays, result.first.direct + result.first.indirect)
        if images is not None:
            result.shown = Shown(images, result.radiance, result.distance, bright)
        return result

    def _segment(
        self,
        paths: _Paths,
        rays: _Rays,
        depth: int,
        last: bool,
        choose: Callable[[Tensor], LightChoice] | None,
        parts: Tensor | None,
        images: Images | None,
        result: PathSamples,
        timer: PhaseTimer,
    ) -> tuple[_Paths, _Rays | None]:
        """Trace the paths to their next surface, gather light there, and choose how they go on; None where none does."""
        crossing = FIRST_CROSSING + MAX_CROSSINGS * depth
        found, traced = self.opacity.nearest(rays.origin, rays.direction, paths.random, crossing, timer, rays.alive, parts)
        result.rays += traced
        beyond, hit, met = images if depth > 1 else None, found.hit, found.met
        if len(found.ended) > 0:
            paths.end(found.ended)
        if len(found.missed) > 0:
            self._end_in_environment(paths.select(found.missed), rays.select(found.missed), depth, beyond, result)
        if len(hit.triangle) == 0:
            return paths, None
        origin, direction = rays.origin, rays.direction
        if met is not None:
            paths, origin, direction = paths.select(met), origin.index_select(1, met), direction.index_select(1, met)
        surface = self.geometry.surface(origin, direction, hit)
        if depth == 1:
            put(result.distance, paths.index, hit.distance)
            put(result.triangle, paths.index, hit.triangle)
            put(result.normal, paths.index, surface.normal)
            put(result.albedo, paths.index, surface.base_color)
            result.alpha.scatter_(0, paths.index, 1.0)
        transmittance = self.geometry.transmittance(hit, surface.front)
        if transmittance is not None:
            paths.throughput *= transmittance
        if len(found.lamps) > 0:
            self._add_emission(paths, rays, found, surface, beyond)
        if depth == 1:
            put(result.emission, paths.index, paths.radiance)
        paths.choice = None if choose is None else choose(surface.position)
        if last:
            paths.finish()
            return paths, None
        owner = None
        if parts is not None:
            parts = parts.index_select(0, paths.index).long()
            paths, surface, owner = self._split(paths, parts, found, surface, images, result)
        if images is not None:
            images.arrive(paths.index, hit, surface, owner)
        dimension = FIRST_DIMENSION + DIMENSIONS * (depth - 1)
        draw = paths.random.uniform
        if depth == 1:
            draw = partial(paths.random.stratified, first=paths.choice.block if paths.choice else 1)
        choice = draw(dimension, 1)[0] if self.geometry.materials.has_transmission else None
        scattering = Scattering(surface, choice)
        if not self.lights.empty:
            self._add_direct_light(paths, surface, scattering, draw(dimension + 5, 6), depth, images, result, timer)
        uniforms = draw(dimension + 1, 4 if depth >= ROULETTE_DEPTH else 3)
        return paths, self._scatter(paths, surface, scattering, uniforms, depth, images, result)

    def _split(
        self, paths: _Paths, parts: Tensor, found: Arrivals, met: Surface, images: Images | None, result: PathSamples
    ) -> tuple[_Paths, Surface, Tensor]:
        """Split the paths at their first surfaces, and note what is there; returns the surfaces of all of them too, and which each was."""
        index, emission = paths.index, paths.radiance
        paths, owner = paths.split(parts, found.onward)
        surface = met.select(owner)
        result.first = FirstSurfaces(self.geometry, index, found.hit, met, emission, owner, surface, parts, indirect=paths.brought)
        if images is not None:
            images.split(result.first.rays)
        return paths, surface, owner

    def _end_in_environment(
        self, gone: _Paths, rays: _Rays, depth: int, images: Images | None, result: PathSamples
    ) -> None:
        """Add the environment's radiance to paths that left the scene, and end them."""
        environment = self.lights.environment
        if environment is not None and (depth > 1 or environment.visible):
            vertex, _, direction, pdf, _ = rays
            weight = mis.power_heuristic(pdf, self.lights.environment_pdf(vertex, direction, gone.choice))
            arrived = gone.throughput * environment.radiance(direction) * weight
            gone.radiance += arrived
            if images is not None:
                images.add(gone.index, torch.full_like(weight, MISS_DISTANCE), arrived)
            if depth == 1:
                result.alpha[gone.index] = environment.alpha(direction)
        gone.finish()

    def _add_emission(self, paths: _Paths, rays: _Rays, found: Arrivals, surface: Surface, images: Images | None) -> None:
        """Add what the lamps emit that rays met, weighed against light sampling; paths, surface: of the rays that met any surface."""
        index = found.lamps
        lamp = Hit(*(field.index_select(0, index) for field in found.hit))
        rays = rays.select(index if found.met is None else found.met.index_select(0, index))
        outgoing = surface.outgoing.index_select(1, index)
        radiance = self.geometry.emission(lamp, surface.front.index_select(0, index), outgoing)
        # As `Lights.sample` sees it, from the vertex itself and not from where the ray left it.
        offset = surface.position.index_select(1, index) - rays.vertex
        distance = length(offset)
        cosine = dot(surface.geometric_normal.index_select(1, index), offset) / distance.clamp(min=1e-30)
        choice = None if paths.choice is None else paths.choice.select(index)
        other = self.lights.triangle_pdf(rays.vertex, lamp.triangle, distance, cosine, choice)
        weight = mis.power_heuristic(rays.pdf, other)
        arrived = paths.throughput.index_select(1, index) * radiance * weight
        paths.radiance.index_add_(1, index, arrived)
        if images is not None:
            images.add(paths.index.index_select(0, index), distance, arrived)

    def _add_direct_light(
        self,
        paths: _Paths,
        surface: Surface,
        scattering: Scattering,
        uniforms: Tensor,
        depth: int,
        images: Images | None,
        result: PathSamples,
        timer: PhaseTimer,
    ) -> None:
        """Next-event estimation: one shadow ray a path."""
        light = direct_light(self.lights, surface, scattering, paths.choice, uniforms, paths.random)
        contribution, brightest, *ray = _shadow_ray(surface, paths.throughput, light.direction, light.distance, light.value)
        visibility, traced = self.opacity.transmittance(*ray, brightest, timer)
        result.rays += traced
        contribution *= visibility
        if depth == 1 and result.first is not None:
            result.first.towards_light, result.first.direct = light.direction, contribution
        else:
            paths.radiance += contribution
        if images is not None:
            images.add_sampled(paths.index, light.direction, light.pdf, light.distance, contribution)
        if paths.choice is not None:
            result.lights = LightsChosen(paths.choice.row, light.cluster, light.worth * visibility, visibility)

    def _scatter(
        self,
        paths: _Paths,
        surface: Surface,
        scattering: Scattering,
        uniforms: Tensor,
        depth: int,
        images: Images | None,
        result: PathSamples,
    ) -> _Rays:
        """Sample the BSDF, and play Russian roulette where there are uniform numbers `[4, N]` and not `[3, N]`."""
        direction, weight, pdf = scattering.sample(uniforms[0:3])
        if depth == 1 and result.first is not None:
            result.first.onward = direction
        if images is not None:
            images.leave(direction, pdf)
        chance = uniforms[3] if len(uniforms) > 3 else None
        origin, paths.throughput, survival = _next_segment(surface, paths.throughput, direction, weight, chance)
        return _Rays(surface.position, origin, direction, pdf, survival)


@kernel
def _shadow_ray(surface: Surface, throughput: Tensor, direction: Tensor, distance: Tensor, value: Tensor) -> tuple[Tensor, ...]:
    """What light samples bring if nothing blocks them, `[3, N]`, its largest channel, and origins, directions and lengths of rays.

    Rays lead from the origin off the surface to the same point: a lamp close by must not shadow itself.
    """
    contribution = throughput * value
    origin = surface.leave(direction)
    target = direction - (origin - surface.position) / distance
    stretch = length(target)
    return contribution, contribution.amax(0), origin, target / stretch, distance * stretch * (1.0 - 1e-4)


@kernel
def _next_segment(
    surface: Surface, throughput: Tensor, direction: Tensor, weight: Tensor, uniform: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Origins and throughputs `[3, N]` of paths that go on, and a number `[N]` that is positive where they do (Russian roulette,
    from uniform numbers `[N]` if there are any)."""
    throughput = throughput * weight
    survival = throughput.amax(0)
    if uniform is not None:
        chance = survival.clamp(max=0.95)
        survival = chance * (uniform < chance)
        throughput = throughput / chance.clamp(min=1e-20)
    return surface.leave(direction), throughput, survival
