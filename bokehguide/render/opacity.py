"""What rays meet, where some surfaces may let light through: alpha masks and blended sheets.

Embree knows triangles only. Rays that scatter are sent on from a sheer surface by chance,
1 - opacity of them; shadow rays go through all of them and are dimmed.

Rays are traced on the host, and sorted out there as well: which of them are traced at all, and what becomes of them. So where
nothing is sheer, the host waits for a GPU once for rays and once for shadow rays, and never for how many there are of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render import triangles
from bokehguide.render.geometry import Geometry, leaving_distance
from bokehguide.render.pixels import indices, parted
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.render.tracer import Hit, Tracer
from bokehguide.render.transfers import fetched, sent
from bokehguide.scene.types import Mesh

MAX_CROSSINGS = 256
"""A ray that went through this many surfaces stops at the next one."""
SHORT = 1.0 / 16.0
"""Beyond a sheer surface rays start this much nearer to it than scattered ones: a wall may be close behind a decal."""


class Arrivals(NamedTuple):
    """What became of N rays: places, int64, of those that had ended before, of those that left the scene and of those that met a
    surface, None where all did; where they met it, as many; which of those, int64, met lamps; and how many paths go on."""

    ended: Tensor
    missed: Tensor
    met: Tensor | None
    hit: Hit
    lamps: Tensor
    onward: int


class Arriving(NamedTuple):
    """Rays along which light comes through, of those that were asked for: their places, int64 `[K]`; the share of it, distances and
    what the rays were worth, `[K]` each. All but the share is on the host."""

    index: Tensor
    share: Tensor
    distance: Tensor
    worth: Tensor


class Opacity:
    """Nearest surfaces and transmittance along batches of rays. Threads may call it side by side.

    A scene of opaque materials is traced as it is.
    """

    def __init__(self, geometry: Geometry, meshes: tuple[Mesh, ...]):
        self._geometry = geometry
        sheer = geometry.materials.sheer.tolist()
        self._emits = geometry.materials.emissive.index_select(0, geometry.material).cpu()
        """Which triangles are lamps, bool `[T]`, on the host."""
        self._opaque, self._sheer = geometry.tracer, None
        if geometry.materials.has_sheer:
            self._opaque, _ = _part(meshes, [not sheer[mesh.material] for mesh in meshes])
            self._sheer, numbers = _part(meshes, [sheer[mesh.material] for mesh in meshes])
            self._numbers = torch.from_numpy(numbers).to(geometry.device)

    def nearest(
        self,
        origins: Tensor,
        directions: Tensor,
        random: PixelRandom,
        dimension: int,
        timer: PhaseTimer,
        alive: Tensor | None = None,
        parts: Tensor | None = None,
    ) -> tuple[Arrivals, int]:
        """What surfaces rays `[3, N]` stop at, and the number of rays traced.

        alive: positive, `[N]`, for those that have not ended before, where some may have; parts: into how many paths they split
        there, float32 `[N]`, if not one. Surface by surface the rays use up one
        random dimension from `dimension` on. Distances are from the origins.
        """
        numbers = [values for values in (alive, parts) if values is not None]
        origin, direction, *numbers = fetched(origins, directions, *numbers)
        going, ended = (None, torch.zeros(0, dtype=torch.int64)) if alive is None else parted(numbers[0] > 0.0)
        if len(ended) > 0:
            origin, direction = origin.index_select(1, going), direction.index_select(1, going)
        with timer.measure("tracing rays"):
            hit = self._geometry.tracer.intersect(origin, direction)
        traced, device = len(hit.triangle), origins.device
        if self._sheer is not None:
            if len(ended) > 0:
                index = sent(going, device)
                origins, directions, random = origins.index_select(1, index), directions.index_select(1, index), random.select(index)
            hit, more = self._beyond_sheer(origins, directions, hit, random, dimension, timer)
            traced += more
        missed, met = parted(hit.triangle < 0)
        if len(missed) > 0:
            hit = Hit(*(field.index_select(0, met) for field in hit))
        lamps = indices(self._emits.index_select(0, hit.triangle))
        if len(ended) > 0:
            missed, met = going.index_select(0, missed), going.index_select(0, met)
        onward = len(met) if parts is None else int(numbers[-1].index_select(0, met).sum(dtype=torch.float64))
        met = sent(met, device) if len(ended) + len(missed) > 0 else None
        ended, missed, lamps, *hit = (sent(values, device) for values in (ended, missed, lamps, *hit))
        return Arrivals(ended, missed, met, Hit(*hit), lamps, onward), traced

    def _beyond_sheer(
        self, origins: Tensor, directions: Tensor, hit: Hit, random: PixelRandom, dimension: int, timer: PhaseTimer
    ) -> tuple[Hit, int]:
        """Where rays stop that meet `hit`, on the host, first; and the number of rays traced on the way."""
        tracer, geometry, rays = self._geometry.tracer, self._geometry, 0
        hit = Hit(*(sent(field, origins.device) for field in hit))
        index = torch.arange(len(hit.triangle), device=origins.device)
        last = torch.full_like(hit.triangle, -1)
        for crossing in range(MAX_CROSSINGS):
            index = index[hit.triangle[index] >= 0]
            index = index[geometry.is_sheer(hit.triangle[index])]
            found = Hit(*(field[index] for field in hit))
            uniform = random.select(index).uniform(dimension + crossing, 1)[0]
            # A straight ray meets a triangle once: what it meets again is where it just was.
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
        triangle, *others = fetched(hit.triangle.view(torch.float32), *hit[1:])
        return Hit(triangle.view(torch.int32), *others), rays

    def transmittance(
        self, origins: Tensor, directions: Tensor, distances: Tensor, worth: Tensor, timer: PhaseTimer
    ) -> tuple[Tensor, int]:
        """Share of the light `[N]` that comes through within `distances` `[N]` of rays `[3, N]`, and rays traced.

        worth: positive, `[N]`, for the rays that are asked for; 0 comes through along the others.
        """
        index, share, *_ = self._unblocked(origins, directions, distances, worth, timer)
        traced = len(index)
        share = torch.zeros(len(worth)).scatter_(0, index, share) if traced < len(worth) else share
        share = sent(share, origins.device)
        if self._sheer is None:
            return share, traced
        return share, traced + self._dim(share, origins, directions, distances, timer)

    def arriving(
        self, origins: Tensor, directions: Tensor, distances: Tensor, worth: Tensor, timer: PhaseTimer
    ) -> tuple[Arriving, int]:
        """As `transmittance`, but of the rays alone along which anything may come through; the host knows how many they are."""
        index, share, length, asked = self._unblocked(origins, directions, distances, worth, timer)
        traced, through = len(index), indices(share > 0.0)
        index, share, length, asked = (values.index_select(0, through) for values in (index, share, length, asked))
        share = sent(share, origins.device)
        if self._sheer is not None:
            there = sent(index, origins.device)
            traced += self._dim(share, *(values.index_select(-1, there) for values in (origins, directions, distances)), timer)
        return Arriving(index, share, length, asked), traced

    def _unblocked(
        self, origins: Tensor, directions: Tensor, distances: Tensor, worth: Tensor, timer: PhaseTimer
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Places of the rays that are asked for, int64 `[K]`, what opaque surfaces let through along them, how long they are, and what
        they are worth, `[K]` each, on the host."""
        *rays, worth = fetched(origins, directions, distances, worth)
        index = indices(worth > 0.0)
        if len(index) < len(worth):
            *rays, worth = (values.index_select(-1, index) for values in (*rays, worth))
        share = torch.ones(len(index))
        if self._opaque is not None:
            with timer.measure("tracing rays"):
                share = self._opaque.visible(*rays)
        return index, share, rays[2], worth

    def _dim(self, share: Tensor, origins: Tensor, directions: Tensor, distances: Tensor, timer: PhaseTimer) -> int:
        """Take from the share of the light that comes through what sheer surfaces stop; returns the number of rays traced."""
        index, rays = indices(share > 0.0), 0
        start, origin = torch.zeros_like(distances[index]), origins[:, index]
        last = torch.full_like(index, -1)
        for _ in range(MAX_CROSSINGS):
            with timer.measure("tracing rays"):
                found = self._sheer.intersect(origin, directions[:, index], distances[index] - start)
            rays += len(index)
            met = indices(found.triangle >= 0)
            index, found = index[met], Hit(*(field[met] for field in found))
            triangle = self._numbers.index_select(0, found.triangle)
            opacity = self._geometry.opacity(found._replace(triangle=triangle))
            again = triangle == last[met]
            share[index] *= 1.0 - opacity * ~again
            start, origin = _beyond(origins[:, index], directions[:, index], found.distance + start[met], again)
            goes_on = indices((share[index] > 0.0) & (start < distances[index]))
            index, last, start, origin = index[goes_on], triangle[goes_on], start[goes_on], origin[:, goes_on]
            if len(index) == 0:
                break
        share[index] = 0.0
        return rays


def _beyond(origins: Tensor, directions: Tensor, distance: Tensor, again: Tensor) -> tuple[Tensor, Tensor]:
    """Distances `[N]` just beyond surfaces at `distance` along rays `[3, N]`, and the points there.

    again: bool `[N]`, whether the short step did not lead beyond.
    """
    step = SHORT + (1.0 - SHORT) * again
    start = distance + step * leaving_distance(origins + distance * directions, distance)
    return start, origins + start * directions


def _part(meshes: tuple[Mesh, ...], chosen: list[bool]) -> tuple[Tracer | None, np.ndarray]:
    """A tracer over some of the meshes (None if there is none), and its triangles' numbers among all."""
    numbers = [np.arange(span.start, span.stop) for (_, span), wanted in zip(triangles.spans(meshes), chosen) if wanted]
    if not numbers:
        return None, np.zeros(0, np.int64)
    return Tracer(*triangles.joined([mesh for mesh, wanted in zip(meshes, chosen) if wanted])), np.concatenate(numbers)
