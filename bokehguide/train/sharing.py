"""Neighbouring pixels share what their rays found: each looks at the others' first surfaces through a lens point of its own.

What is out of focus is seen by many pixels. Where a ray of one pixel found it, the light that its paths brought there goes
to the others of its group as well (Bekaert, Sbert and Halton 2002): through the lens point from which the other one's focus
point and the same surface are in one line, Area ReSTIR's reconnection (`restir/shifts.py`), if nothing is in between.
It is multiple importance sampling: a point x that the densities p_k = q_k |∂l_k / ∂x| of a group's pixels k find counts for
pixel i as W V_i |∂l_i / ∂x| / (A Σ_k V_k p_k) (balance heuristic), where V is whether a pixel can see it. What is in focus is
seen by one pixel alone, and counts as W / (A q). At silhouettes, where a shading normal faces one of two pixels and gives way
before the other one, x is not the same surface for both: V is 0 between them.

Groups are tiles of the film that lie elsewhere in every step, wide or high, so that no tile shows. They end where bands of rows
and of columns end, so that ranks, batches and the squares that adaptive sampling stops hold whole ones. The noise of the
pixels of a group is correlated.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.models.lens_distribution import LensMixture
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.first_surfaces import FirstSurfaces
from bokehguide.render.kernels import kernel
from bokehguide.render.lens import Lens
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.pixels import Pixels, indices, pixel_numbers, put, put_where, worthwhile
from bokehguide.render.random import hash_int
from bokehguide.render.timer import PhaseTimer
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.transfers import sent
from bokehguide.render.vector import dot, length
from bokehguide.restir.shifts import reconnect, reconnection_jacobian
from bokehguide.train.guide import LensDraw
from bokehguide.train.ranks import BAND

LONG, SHORT = 4, 2
"""Pixels along the sides of a group: powers of two."""
COLUMNS = 32
"""Columns of a film after which groups end."""
APART = 3.0
"""Pixels that those of a group are apart, about."""
SMOOTH = 0.5
"""A surface is shared if its GGX α is at least so many times the angle, in radians, between those who look at it: of what
is mirrored, one pixel's paths do not know what another one sees."""
TOGETHER = 65536
"""Pairs of pixels that a CPU deals with together, about: of many, memory is what takes time, and of few, Python."""
NOWHERE, INFINITE = 1e15, 1e30


class Shared(NamedTuple):
    """What N pixels see through each other's eyes: W L / (A q) summed over all who found it, `[3, N]`, and the sum of the weights
    alone, whose mean is 1, `[N]`."""

    radiance: Tensor
    weight: Tensor


class _Seen(NamedTuple):
    """What the samples of a batch met, in the camera frame: the plane `[3, N]` of the first surface (see `Reservoirs`), depth
    `[N]`, and whether it may be shared, bool `[N]`; place: of the sample among the first surfaces, int64 `[N]`, -1 for none."""

    plane: Tensor
    depth: Tensor
    shareable: Tensor
    place: Tensor


class _View(NamedTuple):
    """How J pixels see samples of others: whose they are and who sees them, int64 `[J]`; through which lens points `[2, J]`;
    |∂l' / ∂l| times the share of the light that arrives, and W / A there, `[J]`; the unit directions to them, `[3, J]`; which
    of them are first surfaces, int64 `[K]`, and of how many paths in all; and where those of each row of viewers end, the first
    at 0. In a row, nobody sees or is seen twice."""

    source: Tensor
    viewer: Tensor
    points: Tensor
    jacobian: Tensor
    passing: Tensor
    outgoing: Tensor
    met: Tensor
    paths: int
    ends: list[int]


class _Ways(NamedTuple):
    """Rays to lens points from what is seen there: unit directions in which light leaves, world origins and directions `[3, J]`, and
    lengths `[J]`, MISS_DISTANCE from what lies at infinity; and how many paths brought the light, 0 where it cannot leave so, `[J]`."""

    outgoing: Tensor
    origin: Tensor
    direction: Tensor
    distance: Tensor
    paths: Tensor


class PathSharing:
    """Shares the samples of the pixels of a film. Threads may call it side by side, with batches of whole groups.

    width: of the film, pixels; seed: of the groups' places.
    """

    def __init__(self, camera: ThinLensCamera, tracer: PathTracer, width: int, seed: int):
        self._camera, self._tracer, self._width, self._seed = camera, tracer, width, seed

    def share(
        self, step: int, places: Pixels, focus: Tensor, draw: LensDraw, samples: PathSamples, depth: Tensor, timer: PhaseTimer
    ) -> Shared:
        """Share the samples of one step.

        places: of the pixels on the film; focus: their focus points x_F `[3, N]`; draw: their lens points; samples: what was
        found through those; depth: of it along the axis, `[N]`. Rays are added to those of the samples. A sample that is not
        finite is so in its own pixel alone.
        """
        lens, points = self._camera.lens, draw.points
        mixture = None if draw.batch is None else draw.batch.distribution
        own = lens.transmission(points) / lens.area if draw.at is None else draw.at.density
        seen = self._seen(draw, samples, depth)
        arriving = self._own_transmittance(seen, points, focus, samples, timer)
        total, views = own * arriving, []
        key = hash_int(hash_int(self._seed ^ 0x68E31DA4) + step)
        members = _members(places, self._width, key, focus.device)
        together = max(1, TOGETHER // len(total)) if focus.device.type == "cpu" else len(members)
        for viewers in members.split(together) if len(members) > 0 else ():
            view = self._view(viewers, focus, points, seen, samples, timer)
            if len(view.source) > 0:
                total.index_add_(0, view.source, self._density(mixture, view, len(total)) * view.jacobian)
                views.append(view)
        scale = torch.where(total > 0.0, 1.0 / total, 0.0)
        weight = torch.where(draw.weight > 0.0, _passing(lens, points, focus) * arriving * scale, 0.0)
        shared = Shared(samples.radiance * weight, weight)
        for view in views:
            weight = (view.passing * view.jacobian * scale.index_select(0, view.source)).nan_to_num(0.0, 0.0, 0.0)
            light = (self._radiance(view, seen, samples) * weight).nan_to_num(0.0, 0.0, 0.0)
            shared.radiance.index_add_(1, view.viewer, light)
            shared.weight.index_add_(0, view.viewer, weight)
        return shared

    def _seen(self, draw: LensDraw, samples: PathSamples, depth: Tensor) -> _Seen:
        camera, first = self._camera, samples.first
        device, environment = depth.device, self._tracer.lights.environment
        place = torch.full(depth.shape, -1, device=device)
        plane = torch.zeros(3, *depth.shape, device=device)
        plane[2] = 1.0
        infinite = (samples.triangle < 0) & (draw.weight > 0.0)
        shareable = infinite & (environment is not None and environment.visible)
        if first is not None:
            normal = camera.axes.T @ first.met.geometric_normal
            position = camera.axes.T @ (first.met.position - camera.position)
            put(plane, first.index, torch.cat((normal[:2], dot(position, normal)[None])))
            put(place, first.index, torch.arange(len(first.index), device=device))
            angle = self._angle(position[2].clamp(min=1e-9))
            put(shareable, first.index, self._spreads(first, SMOOTH * angle))
        return _Seen(plane, torch.where(infinite, INFINITE, depth), shareable, place)

    def _angle(self, depth: Tensor) -> Tensor:
        """Angle in radians `[N]` between the lens points through which pixels of a group see what is at `depth` `[N]`, about."""
        camera, focus = self._camera, self._camera.lens.focus_distance
        apart = APART * camera.pixel_slope * focus * depth / (depth - focus).abs().clamp(min=1e-9)
        return apart.clamp(max=2.0 * camera.lens.radius) / depth

    def _spreads(self, first: FirstSurfaces, least: Tensor) -> Tensor:
        """Which first surfaces look alike from lens points of a group: opaque, with α of at least `least`; bool `[K]`."""
        surface, materials = first.met, self._tracer.geometry.materials
        spreads = (surface.alpha >= least) & (surface.facing > 0.0)
        if surface.clearcoat is not None:
            spreads &= (surface.clearcoat <= 0.0) | (surface.clearcoat_alpha >= least)
        if materials.has_transmission:
            spreads &= surface.transmission * (1.0 - surface.metallic) <= 0.0
        if materials.absorbs:  # how much, depends on the way
            spreads &= surface.front > 0.0
        return spreads

    def _own_transmittance(
        self, seen: _Seen, points: Tensor, focus: Tensor, samples: PathSamples, timer: PhaseTimer
    ) -> Tensor:
        """How likely rays pass all sheer surfaces before what they met, as `_view` has it for the others, `[N]`."""
        if not self._tracer.geometry.materials.has_sheer:
            return torch.ones_like(seen.depth)
        outgoing, *ray, paths = self._ways(seen.place, points, focus, samples)
        share, traced = self._tracer.opacity.transmittance(*ray, paths * seen.shareable, timer)
        samples.rays += traced
        return torch.where(seen.shareable, share, 1.0)

    def _view(
        self, viewers: Tensor, focus: Tensor, points: Tensor, seen: _Seen, samples: PathSamples, timer: PhaseTimer
    ) -> _View:
        """How each row of pixels of `viewers` `[R, N]`, -1 for none, sees the samples of all pixels."""
        rows, count = viewers.shape
        viewer = viewers.flatten()
        focus_seen = focus.index_select(1, viewer.clamp(min=0))
        mine = (points, focus, seen.depth, seen.plane, seen.shareable)
        points, focus, depth, plane, shareable = (_repeated(values, rows) for values in mine)
        through, jacobian = _reconnected(points, focus, focus_seen, depth, plane)
        passing = _passing(self._camera.lens, through, focus_seen) * shareable * (viewer >= 0)
        index = worthwhile(passing > 0.0)
        source = torch.arange(count, device=index.device).repeat(rows)
        among = (seen.place.index_select(0, source.index_select(0, index)), *(values.index_select(1, index) for values in (through, focus_seen)))
        outgoing, *ray, paths = self._ways(*among, samples)
        arriving, traced = self._tracer.opacity.arriving(*ray, paths * (passing.index_select(0, index) > 0.0), timer)
        samples.rays += traced
        # The host knows what arrives, and so how many there are of all that follows.
        begins = torch.arange(rows + 1) * count
        ends = torch.searchsorted(arriving.index, begins if index.device.type != "cpu" else torch.searchsorted(index, begins))
        met = indices(arriving.distance < MISS_DISTANCE)
        paths = int(arriving.worth.index_select(0, met).sum(dtype=torch.float64))
        left = sent(arriving.index, index.device)
        index, outgoing = index.index_select(0, left), outgoing.index_select(1, left)
        every = (source, viewer, through, jacobian, passing)
        source, viewer, through, jacobian, passing = (values.index_select(-1, index) for values in every)
        met = sent(met, index.device)
        return _View(source, viewer, through, jacobian * arriving.share, passing, outgoing, met, paths, ends.tolist())

    def _ways(self, place: Tensor, points: Tensor, focus: Tensor, samples: PathSamples) -> _Ways:
        """Ways to lens points `[2, J]` from the first surfaces at `place` `[J]`, or where that is -1 from what lies at infinity
        beyond `focus` `[3, J]`."""
        first, far = samples.first, place < 0
        if first is None:
            ray = self._camera.rays(focus, points)
            distance = torch.full_like(points[0], MISS_DISTANCE)
            return _Ways(torch.zeros_like(focus), *ray, distance, torch.ones_like(distance))
        there = place.clamp(min=0)
        ends = (values.index_select(-1, there) for values in (first.met.position, first.met.geometric_normal, first.met.offset))
        on_lens = self._camera.axes[:, :2] @ points + self._camera.position
        outgoing, above, origin, direction, distance = _ray_to(on_lens, *ends)
        rises = above & first.same_normals(there, outgoing)
        paths = first.parts.index_select(0, there) * rises.to(torch.float32)
        index = worthwhile(far)
        if len(index) > 0:
            ray = self._camera.rays(focus.index_select(1, index), points.index_select(1, index))
            far = far.index_select(0, index)
            for values, new in ((origin, ray[0]), (direction, ray[1]), (distance, MISS_DISTANCE), (paths, 1.0)):
                put_where(far, values, index, new)
        return _Ways(outgoing, origin, direction, distance, paths)

    def _density(self, mixture: LensMixture | None, view: _View, count: int) -> Tensor:
        """q of the viewers, of `count` pixels, at the lens points through which they see, `[J]`."""
        if mixture is None:
            return self._camera.lens.transmission(view.points) / self._camera.lens.area
        found = []
        for first, end in zip(view.ends, view.ends[1:]):
            viewer = view.viewer[first:end]
            points = torch.full((2, count), NOWHERE, device=viewer.device)
            put(points, viewer, view.points[:, first:end])
            found.append(mixture.pdf(points).index_select(0, viewer))
        return torch.cat(found)

    def _radiance(self, view: _View, seen: _Seen, samples: PathSamples) -> Tensor:
        """Radiance `[3, J]` of the samples as the viewers see it."""
        radiance = samples.radiance.index_select(1, view.source)
        met = view.met
        if len(met) > 0:
            place = seen.place.index_select(0, view.source.index_select(0, met))
            put(radiance, met, samples.first.radiance(place, view.outgoing.index_select(1, met), view.paths))
        return radiance


def _members(places: Pixels, width: int, key: int, device: torch.device) -> Tensor:
    """For each other place in a group, who is there for each of N pixels: its number among them, int64 `[.., N]`, or -1.

    places: of the pixels on a film of this width; key: of where groups begin.
    """
    numbers = pixel_numbers(places, device)
    first, last = (places.start, places.stop - 1) if isinstance(places, slice) else (int(places[0]), int(places[-1]))
    among = torch.full((last - first + 2,), -1, device=device)  # the last one stands for what is elsewhere
    among[numbers - first] = torch.arange(len(numbers), device=device)
    there = numbers - first + _ways(width, key, device).index_select(1, numbers % (BAND * width))
    there = torch.where((there >= 0) & (there < len(among)), there, len(among) - 1)
    return among.index_select(0, there.flatten()).reshape(there.shape)


def _ways(width: int, key: int, device: torch.device) -> Tensor:
    """From each pixel of a band, row by row, to each other place in its group: by how much numbers differ, int64
    `[.., BAND * width]`; out of all films where the band ends before."""
    across, down = (LONG, SHORT) if key & 1 else (SHORT, LONG)
    right, below = (key >> 8) % across, (key >> 16) % down
    sizes = (across * down, BAND, width)
    member, row, x = torch.meshgrid(*(torch.arange(size, device=device) for size in sizes), indexing="ij")
    column = ((x + right) ^ (member % across)) - right
    line = ((row + below) ^ (member // across)) - below
    inside = (column < width) & (column // COLUMNS == x // COLUMNS) & (line >= 0) & (line < BAND)
    return torch.where(inside, (line - row) * width + column - x, -(1 << 40))[1:].flatten(1)


def _repeated(values: Tensor, times: int) -> Tensor:
    """Values `[.., N]` so many times, `[.., times N]`; as they are for once."""
    return values if times == 1 else values.repeat(*[1] * (values.ndim - 1), times)


def _passing(lens: Lens, points: Tensor, focus: Tensor) -> Tensor:
    """W / A at lens points `[2, N]` towards focus points `[3, N]`, `[N]`."""
    return lens.transmission(points) * lens.unblocked(points, focus) / lens.area


@kernel
def _reconnected(points: Tensor, focus: Tensor, other: Tensor, depth: Tensor, plane: Tensor) -> tuple[Tensor, Tensor]:
    """Lens points `[2, N]` that see through `other` focus points what `points` saw through `focus`, and the Jacobian `[N]`."""
    through = reconnect(points, (other - focus)[:2], depth, focus[2])
    return through, reconnection_jacobian(plane, points, through)


@kernel
def _ray_to(through: Tensor, position: Tensor, normal: Tensor, offset: Tensor) -> tuple[Tensor, ...]:
    """Unit directions from surfaces to points `[3, N]`, whether they lead up on `normal`'s side, and rays off the surface."""
    way = through - position
    outgoing = way / length(way)
    origin = position + normal * offset
    ray = through - origin
    distance = length(ray)
    return outgoing, dot(normal, outgoing) > 0.0, origin, ray / distance, distance * (1.0 - 1e-4)
