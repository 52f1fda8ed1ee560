"""Where lamps that polished surfaces mirror, or that glass lets through, appear to be.

A highlight on polished metal wanders over it as the point of the lens does. What stays where it is, and is as far out
of focus as the highlight looks, is the lamp's image: as far behind a flat mirror as the lamp is before it, close behind a
bulging one, and in the focus of a ball of glass. It is found by matrix optics: how a narrow pencil of rays spreads about a path
that has met mirrors and glass alone.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry, Surface
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import PlacesOfEach, increase, worthwhile
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
        self.geometry, self._paths = geometry, count
        self._rays: Tensor | None = None
        self.vertices: list[_Vertex] = []
        self.events: list[_Event] = []
        self.starts = torch.zeros(0, dtype=torch.int64)

    def split(self, rays: Tensor) -> None:
        """From now on indices are those of paths, each of which belongs to one of `rays`, int64 `[P]`."""
        self._rays, self._paths = rays, len(rays)

    def arrive(self, index: Tensor, hit: Hit, surface: Surface, owner: Tensor | None = None) -> None:
        """Some paths, int64 `[K]`, have come to these surfaces; owner: which of the hits each has, where not its own."""
        place = torch.empty(self._paths, dtype=torch.int32, device=index.device)
        place.scatter_(0, index, torch.arange(len(index), dtype=torch.int32, device=index.device))
        self.starts = self.starts if self.vertices else index
        medium = (surface.front, surface.thin, surface.transmission, surface.ior)
        self._at = (place, owner, hit, surface.outgoing, *medium)

    def leave(self, direction: Tensor, pdf: Tensor) -> None:
        """They go on in directions `[3, K]` of which the BSDF samples have this density `[K]`."""
        self.vertices.append(_Vertex(*self._at, direction, pdf))

    def add(self, index: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """Some paths, int64 `[K]`, bring light from where they came to: `[K]` from where they left, `[3, K]`."""
        self.events.append(_Event(self.vertices.copy(), index, distance, radiance))

    def add_sampled(self, index: Tensor, direction: Tensor, pdf: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """As `add`, of what light samples bring to where paths are; direction, pdf: as in `leave`."""
        self.events.append(_Event([*self.vertices, _Vertex(*self._at, direction, pdf)], index, distance, radiance))

    def rays(self, paths: Tensor) -> Tensor:
        """Which ray each of some paths, int64 `[K]`, belongs to."""
        return paths if self._rays is None else self._rays.index_select(0, paths)


class Shown:
    """What N rays see in mirrors and glass, when it is known how much light they bring.

    On a GPU the host is not told at once which of them see highlights there: who asks for the distances after other work does not
    wait. On a CPU they are found at once, and what was noted is forgotten.

    images: what was noted; radiance: of the rays, `[3, N]`; own: their distances `[N]`; bright: luminance of a highlight.
    """

    def __init__(self, images: Images, radiance: Tensor, own: Tensor, bright: float):
        self._images, self._whole, self._distances = images, luminance(radiance), None
        self._own = torch.where(self._goes_on(own) & (self._whole <= bright), MISS_DISTANCE, own)
        self._views, narrow = self._possible(self._whole > bright)
        self._narrow = PlacesOfEach(narrow)
        if own.device.type == "cpu":
            self.distances()

    def distances(self) -> Tensor:
        """Along each ray, `[N]`, to where most of its light appears to come from: to the brightest that mirrors and glass show,
        MISS_DISTANCE where that is at infinity or behind the eye, or its own distance, where less than half is shown so.
        Rays that are not bright and go on in a mirror or glass are taken to see something far beyond.
        """
        if self._distances is None:
            self._distances = self._found()
            self._images = self._views = self._narrow = None
        return self._distances

    def _goes_on(self, own: Tensor) -> Tensor:
        """Which rays, bool `[N]`, met a mirror or glass first, or may have: some of their paths went on narrowly."""
        found, images = torch.zeros_like(own), self._images
        if images.vertices:
            increase(found, images.rays(images.starts), (images.vertices[0].pdf > NARROW).to(own.dtype))
        return found > 0.0

    def _possible(self, bright: Tensor) -> tuple[list[_View], list[Tensor]]:
        """Views of the events by bright rays, bool `[N]`, and where those see them through mirrors and glass alone, bool `[K]` each."""
        views, narrow = [], []
        for event in self._images.events:
            rays = self._images.rays(event.index)
            brings = bright.index_select(0, rays) & (event.radiance.amax(0) > 0.0)
            index = worthwhile(brings)
            path = event.index.index_select(0, index)
            places = [vertex.place.index_select(0, path) for vertex in event.vertices]
            views.append(_View(event, rays.index_select(0, index), index, places))
            narrow.append(brings.index_select(0, index) & (_least_density(event, places) > NARROW))
        return views, narrow

    def _found(self) -> Tensor:
        # The last place is for what is no ray's.
        count = len(self._own)
        distance, light, brightest = torch.zeros(3, count + 1, device=self._own.device)
        for view, index in zip(self._views, self._narrow.get()):
            if len(index) > 0:
                view = view.select(index)
                image, trusted = self._image(view)
                rays = torch.where(trusted, view.rays, count)
                added = luminance(view.event.radiance.index_select(1, view.index))
                increase(light, rays, added)
                brightest.scatter_reduce_(0, rays, added, "amax")
                distance.scatter_(0, torch.where(added == brightest.index_select(0, rays), rays, count), image)
        return torch.where(light[:-1] > 0.5 * self._whole, distance[:-1], self._own)

    def _image(self, view: _View) -> tuple[Tensor, Tensor]:
        """How far off each ray of the view sees it, `[K]`, and whether to believe it."""
        device, vertices, geometry = view.rays.device, view.event.vertices, self._images.geometry
        pencils = sent(BEGUN, device, torch.float32)[:, None].expand(-1, len(view.rays))
        for vertex, place in zip(vertices, view.places):
            triangle = vertex.triangles(place)
            found = (vertex.outgoing, vertex.direction, vertex.front, vertex.thin, vertex.transmission, vertex.ior)
            found = (values.index_select(-1, place) for values in found)
            pencils = _bend(pencils, vertex.distances(place), geometry.corners(triangle), geometry.corner_normals(triangle), *found)
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
