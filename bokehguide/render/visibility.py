"""Nearest surfaces and transmittance along rays. Surfaces with alpha masks or blended alpha are translucent.

Embree treats all triangles as opaque. A camera ray or scattered ray passes a translucent surface with the probability 1 -
opacity. A shadow ray passes all translucent surfaces, and its transmittance is the product of 1 - opacity.

Embree traces rays on the host. The host also selects the rays to trace and sorts their results. In a scene without translucent
surfaces, the host therefore waits for a GPU only once for each batch of rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render import triangles
from bokehguide.render.dimensions import MAX_CROSSINGS
from bokehguide.render.geometry import Geometry, leaving_distance
from bokehguide.render.random import PixelRandom
from bokehguide.render.tracer import Hit, Tracer
from bokehguide.runtime.device import to_device, to_host
from bokehguide.runtime.indexing import indices, partition_indices
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Mesh

SHORT = 1.0 / 16.0
"""Offset of rays beyond a translucent surface over the offset of scattered rays, for walls that are close behind a decal."""


class Arrivals(NamedTuple):
    """Results of N rays. All indices are int64.

    ended: rays that were not alive. missed: rays that left the scene. met: rays that met a surface, `[M]`, None for all N rays.
    hit: hits of the rays that met a surface, `[M]`. emitters: indices into `hit` of hits on emitters. path_count: number of paths
    that leave the surfaces.
    """

    ended: Tensor
    missed: Tensor
    met: Tensor | None
    hit: Hit
    emitters: Tensor
    path_count: int


class VisibleRays(NamedTuple):
    """K shadow rays with a positive transmittance: indices, int64 `[K]`; transmittances, lengths and weights, `[K]` each. Only
    the transmittances are on the device; all other values are on the host."""

    rays: Tensor
    transmittance: Tensor
    distance: Tensor
    weight: Tensor


class _HostSorting:
    """Sorts N rays on the host: the rays to trace, and their hits.

    alive: positive for rays to trace, `[N]`, None for all. counts: number of paths that leave the surface that a ray meets,
    `[N]`, None for one path.
    """

    def __init__(self, alive: Tensor | None, counts: Tensor | None):
        self.ended, self._going, self._counts = torch.zeros(0, dtype=torch.int64), None, counts
        if alive is not None:
            going, self.ended = partition_indices(alive > 0.0)
            self._going = going if len(self.ended) > 0 else None  # None for all

    def traced(self, values: Tensor) -> Tensor:
        """Values `[.., K]` of the traced rays, of `[.., N]`."""
        return values if self._going is None else values.index_select(-1, to_device(self._going, values.device))

    def traced_random(self, random: PixelRandom, device: torch.device) -> PixelRandom:
        """Random numbers of the traced rays."""
        return random if self._going is None else random.select(to_device(self._going, device))

    def arrivals(self, hit: Hit, emits: Tensor, device: torch.device) -> Arrivals:
        """Results of the traced rays, moved to a device; emits: which triangles are emitters, bool `[T]`."""
        missed, met = partition_indices(hit.triangle < 0)
        if len(missed) > 0:
            hit = Hit(*(field.index_select(0, met) for field in hit))
        emitters = indices(emits.index_select(0, hit.triangle))
        if self._going is not None:
            missed, met = self._going.index_select(0, missed), self._going.index_select(0, met)
        path_count = len(met) if self._counts is None else int(self._counts.index_select(0, met).sum(dtype=torch.float64))
        everywhere = len(self.ended) + len(missed) == 0
        ended, missed, emitters, *fields = (to_device(values, device) for values in (self.ended, missed, emitters, *hit))
        return Arrivals(ended, missed, None if everywhere else to_device(met, device), Hit(*fields), emitters, path_count)


class Visibility:
    """Nearest surfaces and transmittance along batches of rays. Threads may call the methods concurrently."""

    def __init__(self, geometry: Geometry, meshes: tuple[Mesh, ...]):
        self._geometry = geometry
        self._emits = geometry.materials.emissive.index_select(0, geometry.material).cpu()
        """Which triangles are emitters, bool `[T]`, on the host."""
        self.opaque: Tracer | None = geometry.tracer
        self.translucent: Tracer | None = None
        self.numbers: Tensor | None = None
        """Numbers among all triangles of those of the translucent tracer, int64."""
        if geometry.materials.has_translucent:
            translucent = geometry.materials.translucent.tolist()
            threads = geometry.tracer.threads
            self.opaque, _ = _part(meshes, [not translucent[mesh.material] for mesh in meshes], threads)
            self.translucent, numbers = _part(meshes, [translucent[mesh.material] for mesh in meshes], threads)
            self.numbers = torch.from_numpy(numbers).to(geometry.device)

    def nearest(
        self,
        origins: Tensor,
        directions: Tensor,
        random: PixelRandom,
        dimension: int,
        timer: PhaseTimer,
        alive: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> tuple[Arrivals, int]:
        """Surfaces at which rays `[3, N]` stop, and the number of rays traced.

        dimension: random dimension of the first translucent surface that a ray meets; each further surface uses the next
        dimension. alive: positive for rays to trace, `[N]`, None for all. counts: number of paths that leave the surface, float32
        `[N]`, None for one path. Distances are from the origins of the rays.
        """
        origin, direction, *given = to_host(origins, directions, *(values for values in (alive, counts) if values is not None))
        sorting = _HostSorting(None if alive is None else given[0], None if counts is None else given[-1])
        with timer.measure("tracing rays"):
            hit = self._geometry.tracer.intersect(sorting.traced(origin), sorting.traced(direction))
        count = len(hit.triangle)
        if self.translucent is not None:
            random = sorting.traced_random(random, origins.device)
            hit, more = self._beyond_translucent(
                sorting.traced(origins), sorting.traced(directions), hit, random, dimension, timer
            )
            count += more
        return sorting.arrivals(hit, self._emits, origins.device), count

    def _beyond_translucent(
        self, origins: Tensor, directions: Tensor, hit: Hit, random: PixelRandom, dimension: int, timer: PhaseTimer
    ) -> tuple[Hit, int]:
        """Surfaces at which rays stop that first meet `hit`, on the host, and the number of further traced rays."""
        tracer, geometry, rays = self._geometry.tracer, self._geometry, 0
        hit = Hit(*(to_device(field, origins.device) for field in hit))
        index = torch.arange(len(hit.triangle), device=origins.device)
        last = torch.full_like(hit.triangle, -1)
        for crossing in range(MAX_CROSSINGS):
            index = index[hit.triangle[index] >= 0]
            index = index[geometry.is_translucent(hit.triangle[index])]
            found = Hit(*(field[index] for field in hit))
            uniform = random.select(index).uniform(dimension + crossing, 1)[0]
            # A straight ray meets a triangle once: a second hit of the last triangle is a rounding error.
            again = found.triangle == last[index]
            goes_on = (uniform >= geometry.opacity(found)) | again
            index = index[goes_on]
            if len(index) == 0:
                break
            last[index] = hit.triangle[index]
            start, origin = _beyond(origins[:, index], directions[:, index], hit.distance[index], again[goes_on])
            with timer.measure("tracing rays"):
                found = tracer.intersect(origin, directions[:, index])
            rays += len(index)
            for field, value in zip(hit, found._replace(distance=found.distance + start)):
                field[index] = value
        triangle, *others = to_host(hit.triangle.view(torch.float32), *hit[1:])
        return Hit(triangle.view(torch.int32), *others), rays

    def transmittance(
        self, origins: Tensor, directions: Tensor, distances: Tensor, weight: Tensor, timer: PhaseTimer
    ) -> tuple[Tensor, int]:
        """Transmittance `[N]` of rays `[3, N]` of lengths `distances` `[N]`, and the number of rays traced.

        weight: positive, `[N]`, for rays to trace; the transmittance of the others is 0.
        """
        rays, visible, *_ = self._unblocked(origins, directions, distances, weight, timer)
        count = len(rays)
        transmittance = torch.zeros(len(weight)).scatter_(0, rays, visible) if count < len(weight) else visible
        transmittance = to_device(transmittance, origins.device)
        return transmittance, count + self._dim(transmittance, origins, directions, distances, timer)

    def visible_rays(
        self, origins: Tensor, directions: Tensor, distances: Tensor, weight: Tensor, timer: PhaseTimer
    ) -> tuple[VisibleRays, int]:
        """As `transmittance`, but only for the K rays with a positive transmittance. The host knows K."""
        rays, visible, length, weight = self._unblocked(origins, directions, distances, weight, timer)
        count, through = len(rays), indices(visible > 0.0)
        rays, visible, length, weight = (values.index_select(0, through) for values in (rays, visible, length, weight))
        transmittance = to_device(visible, origins.device)
        if self.translucent is not None:
            index = to_device(rays, origins.device)
            origin, direction, distance = (values.index_select(-1, index) for values in (origins, directions, distances))
            count += self._dim(transmittance, origin, direction, distance, timer)
        return VisibleRays(rays, transmittance, length, weight), count

    def _unblocked(
        self, origins: Tensor, directions: Tensor, distances: Tensor, weight: Tensor, timer: PhaseTimer
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The K rays with a positive weight, on the host: indices, int64 `[K]`; 1 if no opaque surface blocks the ray, else 0;
        length; and weight, `[K]` each."""
        origin, direction, distance, weight = to_host(origins, directions, distances, weight)
        index = indices(weight > 0.0)
        if len(index) < len(weight):
            selected = (values.index_select(-1, index) for values in (origin, direction, distance, weight))
            origin, direction, distance, weight = selected
        visible = torch.ones(len(index))
        if self.opaque is not None:
            with timer.measure("tracing rays"):
                visible = self.opaque.visible(origin, direction, distance)
        return index, visible, distance, weight

    def _dim(self, transmittance: Tensor, origins: Tensor, directions: Tensor, distances: Tensor, timer: PhaseTimer) -> int:
        """Multiply `transmittance` `[N]` by that of the translucent surfaces, in place; returns the number of traced rays."""
        if self.translucent is None:
            return 0
        index, count = indices(transmittance > 0.0), 0
        start, origin = torch.zeros_like(distances[index]), origins[:, index]
        last = torch.full_like(index, -1)
        for _ in range(MAX_CROSSINGS):
            with timer.measure("tracing rays"):
                found = self.translucent.intersect(origin, directions[:, index], distances[index] - start)
            count += len(index)
            met = indices(found.triangle >= 0)
            index, found = index[met], Hit(*(field[met] for field in found))
            assert self.numbers is not None
            triangle = self.numbers.index_select(0, found.triangle)
            opacity = self._geometry.opacity(found._replace(triangle=triangle))
            again = triangle == last[met]
            transmittance[index] *= 1.0 - opacity * ~again
            start, origin = _beyond(origins[:, index], directions[:, index], found.distance + start[met], again)
            goes_on = indices((transmittance[index] > 0.0) & (start < distances[index]))
            index, last, start, origin = index[goes_on], triangle[goes_on], start[goes_on], origin[:, goes_on]
            if len(index) == 0:
                break
        transmittance[index] = 0.0
        return count


def _beyond(origins: Tensor, directions: Tensor, distance: Tensor, again: Tensor) -> tuple[Tensor, Tensor]:
    """Distances `[N]` just beyond surfaces at `distance` along rays `[3, N]`, and the points there.

    again: whether the ray uses the full offset, because the short offset did not pass the surface, bool `[N]`.
    """
    step = SHORT + (1.0 - SHORT) * again
    start = distance + step * leaving_distance(origins + distance * directions, distance)
    return start, origins + start * directions


def _part(meshes: Sequence[Mesh], chosen: list[bool], threads: int) -> tuple[Tracer | None, np.ndarray]:
    """Tracer over the chosen meshes, None without meshes, and the numbers of its triangles among all triangles."""
    numbers = [np.arange(span.start, span.stop) for (_, span), wanted in zip(triangles.spans(meshes), chosen) if wanted]
    if not numbers:
        return None, np.zeros(0, np.int64)
    vertices, corners = triangles.joined([mesh for mesh, wanted in zip(meshes, chosen) if wanted])
    return Tracer(vertices, corners, threads), np.concatenate(numbers)
