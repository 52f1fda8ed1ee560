"""Where lamps that polished surfaces mirror, or that glass lets through, appear to be.

A highlight on polished metal wanders over it as the point of the lens does. What stays where it is, and is as far out
of focus as the highlight looks, is the lamp's image: as far behind a flat mirror as the lamp is before it, close behind a
bulging one, and in the focus of a ball of glass. It is found by matrix optics: how a narrow pencil of rays spreads about a path
that has met mirrors and glass alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry, Surface
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import increase, indices_of_each, worthwhile
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.transfers import sent
from bokehguide.render.vector import cross, dot, length, luminance, normalize

NARROW = 4.0
"""A BSDF that samples a direction with at least this density per steradian shows what lies there: GGX's α is below 0.14."""
AFLOAT = 0.5
"""Images that float in the air, before hollow mirrors, nearer than this part of the way to the first surface are left out: one
stray ray would make a highlight there whose circle of confusion is the whole picture."""
BEGUN = (1.0, 0.0, 0.0, 1.0, 1.0)
"""A pencil of rays at the eye (see `_after`), in air."""
GRAZING = 0.02
"""Cosines to the normal count as at least this."""


class _Vertex(NamedTuple):
    """What paths met, as arrays over them in an order of its own, and where they went on to.

    place: of each path in these arrays, int32 `[P]`, by its index; owner: of each of them, its place in those of the hit, None
    where they are the same.
    """

    place: Tensor
    owner: Tensor | None
    hit: Hit
    outgoing: Tensor
    front: Tensor
    thin: Tensor
    transmission: Tensor
    ior: Tensor
    direction: Tensor
    pdf: Tensor

    def triangles(self, place: Tensor) -> Tensor:
        """Those met, by the places of paths."""
        return self.hit.triangle.index_select(0, self._hits(place))

    def distances(self, place: Tensor) -> Tensor:
        """How far paths came, by their places."""
        return self.hit.distance.index_select(0, self._hits(place))

    def _hits(self, place: Tensor) -> Tensor:
        return place if self.owner is None else self.owner.index_select(0, place)


class _Event(NamedTuple):
    """Light that some paths, int64 `[K]`, brought over vertices from so far beyond the last, `[K]`; radiance `[3, K]`."""

    vertices: list[_Vertex]
    index: Tensor
    distance: Tensor
    radiance: Tensor


class _View(NamedTuple):
    """What rays, int64 `[K]`, see of an event: that light of it which is at `index`, int64 `[K]`, and came over these places in the
    vertices, int32 `[K]` each."""

    event: _Event
    rays: Tensor
    index: Tensor
    places: list[Tensor]

    def select(self, index: Tensor) -> _View:
        places = [place.index_select(0, index) for place in self.places]
        return _View(self.event, self.rays.index_select(0, index), self.index.index_select(0, index), places)


class Images:
    """What N rays see in mirrors and glass.

    What paths meet and bring is noted as it is, and looked up for the few rays that see a highlight.
    """

    def __init__(self, geometry: Geometry, count: int):
        self._geometry, self._paths = geometry, count
        self._rays: Tensor | None = None
        self._vertices: list[_Vertex] = []
        self._events: list[_Event] = []
        self._starts = torch.zeros(0, dtype=torch.int64)

    def split(self, rays: Tensor) -> None:
        """From now on indices are those of paths, each of which belongs to one of `rays`, int64 `[P]`."""
        self._rays, self._paths = rays, len(rays)

    def arrive(self, index: Tensor, hit: Hit, surface: Surface, owner: Tensor | None = None) -> None:
        """Some paths, int64 `[K]`, have come to these surfaces; owner: which of the hits each has, where not its own."""
        place = torch.empty(self._paths, dtype=torch.int32, device=index.device)
        place.scatter_(0, index, torch.arange(len(index), dtype=torch.int32, device=index.device))
        self._starts = self._starts if self._vertices else index
        medium = (surface.front, surface.thin, surface.transmission, surface.ior)
        self._at = (place, owner, hit, surface.outgoing, *medium)

    def leave(self, direction: Tensor, pdf: Tensor) -> None:
        """They go on in directions `[3, K]` of which the BSDF samples have this density `[K]`."""
        self._vertices.append(_Vertex(*self._at, direction, pdf))

    def add(self, index: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """Some paths, int64 `[K]`, bring light from where they came to: `[K]` from where they left, `[3, K]`."""
        self._events.append(_Event(self._vertices.copy(), index, distance, radiance))

    def add_sampled(self, index: Tensor, direction: Tensor, pdf: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """As `add`, of what light samples bring to where paths are; direction, pdf: as in `leave`."""
        self._events.append(_Event([*self._vertices, _Vertex(*self._at, direction, pdf)], index, distance, radiance))

    def distances(self, radiance: Tensor, own: Tensor, bright: float) -> Tensor:
        """Along each ray, `[N]`, to where most of its light appears to come from: to the brightest that mirrors and glass show,
        MISS_DISTANCE where that is at infinity or behind the eye, or its own distance `[N]`, where less than half is shown so.
        Rays that are not bright and go on in a mirror or glass are taken to see something far beyond.

        radiance: of the rays, `[3, N]`; bright: luminance of a highlight.
        """
        whole = luminance(radiance)
        own = torch.where(self._goes_on(own) & (whole <= bright), MISS_DISTANCE, own)
        # The last place is for what is no ray's.
        distance, light, brightest = torch.zeros(3, len(own) + 1, device=own.device)
        for rays, image, added in self._seen(whole > bright):
            increase(light, rays, added)
            brightest.scatter_reduce_(0, rays, added, "amax")
            distance.scatter_(0, torch.where(added == brightest.index_select(0, rays), rays, len(own)), image)
        return torch.where(light[:-1] > 0.5 * whole, distance[:-1], own)

    def _goes_on(self, own: Tensor) -> Tensor:
        """Which rays, bool `[N]`, met a mirror or glass first, or may have: some of their paths went on narrowly."""
        found = torch.zeros_like(own)
        if self._vertices:
            increase(found, self._ray_of(self._starts), (self._vertices[0].pdf > NARROW).to(own.dtype))
        return found > 0.0

    def _ray_of(self, paths: Tensor) -> Tensor:
        """Which ray each of some paths, int64 `[K]`, belongs to."""
        return paths if self._rays is None else self._rays.index_select(0, paths)

    def _seen(self, bright: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """What bright rays, bool `[N]`, see of each event through mirrors and glass alone: which rays, int64 `[K]`, how far off, and
        how much light it brings them, `[K]`. Where no image is to be trusted the ray is N."""
        events, rays = self._events, [self._ray_of(event.index) for event in self._events]
        brings = [bright.index_select(0, of) & (event.radiance.amax(0) > 0.0) for event, of in zip(events, rays)]
        shown = [worthwhile(mask) for mask in brings]
        paths = [event.index.index_select(0, index) for event, index in zip(events, shown)]
        places = [[vertex.place.index_select(0, of) for vertex in event.vertices] for event, of in zip(events, paths)]
        narrow = [_least_density(event, at) > NARROW for event, at in zip(events, places)]
        narrow = indices_of_each([mask & of.index_select(0, index) for mask, of, index in zip(narrow, brings, shown)])
        views = [
            _View(event, of.index_select(0, index), index, at).select(which)
            for event, of, index, at, which in zip(events, rays, shown, places, narrow)
            if len(which) > 0
        ]
        for view, corners in zip(views, self._corners(views)):
            image, trusted = self._image(view, corners)
            ray = torch.where(trusted, view.rays, len(bright))
            yield ray, image, luminance(view.event.radiance.index_select(1, view.index))

    def _corners(self, views: list[_View]) -> list[list[Tensor]]:
        """Corners of the triangles at each of the views' vertices: all together, as a GPU's host, which has them, waits to be asked."""
        triangles = [[vertex.triangles(place) for vertex, place in zip(view.event.vertices, view.places)] for view in views]
        every = [triangle for of_view in triangles for triangle in of_view]
        if not every:
            return []
        corners = iter(self._geometry.corners(torch.cat(every)).split([len(triangle) for triangle in every], dim=2))
        return [[next(corners).contiguous() for _ in of_view] for of_view in triangles]

    def _image(self, view: _View, corners: list[Tensor]) -> tuple[Tensor, Tensor]:
        """How far off each ray of the view sees it, `[K]`, and whether to believe it."""
        device, vertices = view.rays.device, view.event.vertices
        pencils = sent(BEGUN, device, torch.float32)[:, None].expand(-1, len(view.rays))
        for vertex, place, at in zip(vertices, view.places, corners):
            normals = self._geometry.corner_normals(vertex.triangles(place))
            found = (vertex.outgoing, vertex.direction, vertex.front, vertex.thin, vertex.transmission, vertex.ior)
            found = (values.index_select(-1, place) for values in found)
            pencils = _bend(pencils, vertex.distances(place), at, normals, *found)
        image = _image(pencils, view.event.distance.index_select(0, view.index))
        return image, image > AFLOAT * vertices[0].distances(view.places[0])


def _least_density(event: _Event, places: list[Tensor]) -> Tensor:
    """With which density, at least, paths went on at their places in the event's vertices, `[K]`."""
    return torch.stack([vertex.pdf.index_select(0, place) for vertex, place in zip(event.vertices, places)]).amin(0)


def _after(pencils: Tensor, distance: Tensor) -> Tensor:
    """Pencils `[5, N]` further on. Rows are A, B, C and D of matrix optics: how far from the middle rays are that began beside it,
    and under an angle to it, and at which angles, times the medium's index, which is the last row."""
    return torch.cat((pencils[:2] + distance / pencils[4] * pencils[2:4], pencils[2:]))


@kernel
def _image(pencils: Tensor, distance: Tensor) -> Tensor:
    """Where what lies so far on `[N]` is seen."""
    across, along = _after(pencils, distance)[:2]
    place = along / torch.where(across == 0.0, 1e-37, across)
    return torch.where(place > 0.0, place.clamp(max=MISS_DISTANCE), MISS_DISTANCE)


@kernel
def _bend(
    pencils: Tensor,
    distance: Tensor,
    corners: Tensor,
    normals: Tensor,
    outgoing: Tensor,
    direction: Tensor,
    front: Tensor,
    thin: Tensor,
    transmission: Tensor,
    ior: Tensor,
) -> Tensor:
    """Pencils that come so far to triangles which mirror or let them through."""
    pencils, incoming = _after(pencils, distance), -outgoing
    index, solid = pencils[4], (thin == 0.0) & (transmission > 0.0)
    mirrored = dot(incoming, normals[0]) * dot(direction, normals[0]) < 0.0
    through = torch.where(solid, refraction_vergence(corners, normals, incoming, direction, front, ior), 0.0)
    vergence = torch.where(mirrored, index * mirror_vergence(corners, normals, incoming), through)
    beyond = torch.where(solid & ~mirrored, torch.where(front > 0.0, ior, 1.0), index)
    return torch.cat((pencils[:2], pencils[2:4] + vergence * pencils[:2], beyond[None]))


def mirror_vergence(corners: Tensor, normals: Tensor, incoming: Tensor) -> Tensor:
    """How much nearer mirrors bring what they show, `[N]`, in dioptres (1/m): the inverse distance of an image behind the
    mirror less that of what is before it, on average over the two principal planes (Coddington's equations).

    corners, normals: of triangles, whose normals are interpolated, `[3, 3, N]` each, corner first; incoming: unit
    directions `[3, N]` in which rays arrive.
    """
    tangential, sagittal, cosine, _ = _bulges(corners, normals, incoming)
    return tangential / cosine + sagittal * cosine


def refraction_vergence(
    corners: Tensor, normals: Tensor, incoming: Tensor, direction: Tensor, front: Tensor, ior: Tensor
) -> Tensor:
    """As `mirror_vergence`, of what is seen through a surface in `direction` `[3, N]`, by mean curvature; distances beyond count
    by the medium's index.

    front: 1 where rays arrive from outside, else 0; ior: of what is inside; `[N]` both.
    """
    tangential, sagittal, cosine, normal = _bulges(corners, normals, incoming)
    before, beyond = torch.where(front > 0.0, 1.0, ior), torch.where(front > 0.0, ior, 1.0)
    return -0.5 * (tangential + sagittal) * (beyond * dot(normal, direction).abs() - before * cosine)


def _bulges(corners: Tensor, normals: Tensor, incoming: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Curvatures `[N]` in the plane of incidence and across it, positive where the surface bulges towards what arrives; the cosine
    `[N]` to its normal `[3, N]`."""
    normal = normalize(normals.mean(0))
    facing = dot(normal, incoming)
    side, cosine = -torch.sign(facing), facing.abs().clamp(min=GRAZING)
    sagittal = cross(normal, incoming)
    # Straight on, any direction along the surface will do.
    upright = (dot(sagittal, sagittal) < 1e-8).to(torch.float32)
    sagittal = normalize(sagittal + upright * cross(normal, corners[1] - corners[0]))
    tangential = cross(normal, sagittal)
    return side * _curvature(corners, normals, tangential), side * _curvature(corners, normals, sagittal), cosine, normal


def _curvature(corners: Tensor, normals: Tensor, along: Tensor) -> Tensor:
    """Normal curvature `[N]` of triangles along unit tangents `[3, N]`, positive where the side of their normals bulges."""
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    base = length(first).clamp(min=1e-30)
    first = first / base
    skew = dot(first, second)
    second = second - skew * first
    height = length(second).clamp(min=1e-30)
    v = dot(along, second / height) / height
    u = (dot(along, first) - v * skew) / base
    return dot(along, u * (normals[1] - normals[0]) + v * (normals[2] - normals[0]))
