"""Virtual images of emitters in mirrors and glass.

A highlight on polished metal moves over the surface with the lens point, but the virtual image of the emitter stays in place.
The image of a flat mirror lies as far behind the mirror as the emitter is in front. A convex mirror has the image close behind
its surface, and a glass ball at its focus. The distance of the image determines the defocus of the highlight. Ray transfer
(ABCD) matrices give the distance for a path that has met only mirrors and glass.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.base import DirectLight
from bokehguide.render.observer import CoreReport, PathObserver
from bokehguide.render.shadow_roulette import MIRROR_PDF
from bokehguide.render.surface import Surface
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.vector import cross, divisor, dot, length, luminance, normalize
from bokehguide.runtime import native
from bokehguide.runtime.device import to_device
from bokehguide.runtime.indexing import ActiveEntries, PendingIndices, scatter_add

NARROW = MIRROR_PDF
"""Least density of a BSDF sample, per steradian, at which a surface shows virtual images: a GGX α below 0.14."""
LEAST_SHARE = 0.5
"""Least distance of an image over the distance to the primary hit. Concave mirrors may form nearer images. A single such path
could create a highlight whose circle of confusion covers the whole picture, so that the search ignores nearer images."""
IDENTITY = (1.0, 0.0, 0.0, 1.0, 1.0)
"""Rows of ABCD at the start of a camera ray, in air (see `propagate_abcd`)."""
SMALLEST = 1e-37
"""Divisor in place of an offset of 0, for an image at infinity."""
GRAZING = 0.02
"""Smallest cosine to the normal, so that powers of surfaces stay finite at grazing angles."""


class _Vertex(NamedTuple):
    """One vertex of each of K paths, and the direction in which the path continues.

    place: index of each path in the other arrays, by path number, int32 `[P]`. owner: index of each vertex in the arrays of
    `hit`, None for the same order. outgoing, direction: unit directions back to the previous vertex and on to the next vertex,
    world frame, `[3, K]`. front, thin, transmission, ior: see `Surface`. pdf: density of `direction`, 1/sr.
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
        """Triangles on which the vertices at `place` lie."""
        return self.hit.triangle.index_select(0, self._hits(place))

    def distances(self, place: Tensor) -> Tensor:
        """Distances from the previous vertices to the vertices at `place`."""
        return self.hit.distance.index_select(0, self._hits(place))

    def _hits(self, place: Tensor) -> Tensor:
        return place if self.owner is None else self.owner.index_select(0, place)


class _Event(NamedTuple):
    """Light that arrives along K paths.

    vertices: all vertices from the lens to the light. paths: int64 `[K]`. distance: from the last vertex to the emitter, `[K]`.
    radiance: contribution to the camera rays, `[3, K]`.
    """

    vertices: list[_Vertex]
    paths: Tensor
    distance: Tensor
    radiance: Tensor


class _View(NamedTuple):
    """Selected entries of an event.

    rays: int64 `[K]`. entries: indices into the arrays of the event, int64 `[K]`. places: indices into each vertex, int32 `[K]`.
    """

    event: _Event
    rays: Tensor
    entries: Tensor
    places: list[Tensor]

    def select(self, index: Tensor) -> _View:
        places = [place.index_select(0, index) for place in self.places]
        return _View(self.event, self.rays.index_select(0, index), self.entries.index_select(0, index), places)


class ImageRecorder(PathObserver):
    """Records the vertices of the paths of N rays, and the light that arrives along the paths.

    `ImageDistances` searches for virtual images along the few rays that see a highlight.
    """

    def __init__(self, geometry: Geometry, count: int):
        self.geometry, self._paths = geometry, count
        self._rays: Tensor | None = None
        self.vertices: list[_Vertex] = []
        self.events: list[_Event] = []
        self.starts = torch.zeros(0, dtype=torch.int64)

    def split(self, rays: Tensor) -> None:
        """See `PathObserver`."""
        self._rays, self._paths = rays, len(rays)

    def vertex(self, paths: Tensor, hit: Hit, surface: Surface, owner: Tensor | None) -> None:
        """See `PathObserver`."""
        place = torch.empty(self._paths, dtype=torch.int32, device=paths.device)
        place.scatter_(0, paths, torch.arange(len(paths), dtype=torch.int32, device=paths.device))
        self.starts = self.starts if self.vertices else paths
        medium = (surface.front, surface.thin, surface.transmission, surface.ior)
        self._at = (place, owner, hit, surface.outgoing, *medium)

    def scattered(self, direction: Tensor, pdf: Tensor) -> None:
        """See `PathObserver`."""
        self.vertices.append(_Vertex(*self._at, direction, pdf))

    def arrival(self, paths: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """See `PathObserver`."""
        self.events.append(_Event(self.vertices.copy(), paths, distance, radiance))

    def light_sample(self, paths: Tensor, light: DirectLight, contribution: Tensor, visibility: Tensor) -> None:
        """See `PathObserver`."""
        vertices = [*self.vertices, _Vertex(*self._at, light.direction, light.bsdf_pdf)]
        self.events.append(_Event(vertices, paths, light.distance, contribution))

    def rays(self, paths: Tensor) -> Tensor:
        """Ray of each path, int64 `[K]`."""
        return paths if self._rays is None else self._rays.index_select(0, paths)


class HighlightImages(ImageRecorder):
    """Records virtual images for the rays of a trace whose luminance is above `bright`.

    distances: function that returns the apparent distances `[N]` of the light along the rays (see `ImageDistances`).
    """

    in_core = True
    distances: Callable[[], Tensor]

    def __init__(self, geometry: Geometry, count: int, bright: float):
        super().__init__(geometry, count)
        self._bright = bright

    def finished(self, radiance: Tensor, distance: Tensor) -> None:
        """See `PathObserver`."""
        self.distances = ImageDistances(self, radiance, distance, self._bright).distances

    def reported(self, report: CoreReport) -> None:
        """See `PathObserver`."""
        core, found = native.core(), torch.empty_like(report.distance)
        assert core is not None
        core.apparent_distances(report.radiance, report.distance, report.images, self._bright, MISS_DISTANCE, found)
        self.distances = lambda: found


class ImageDistances:
    """Apparent distances of the light along N rays, from a record of paths and the radiance of the rays.

    On a CPU, the constructor computes the distances and releases the record. On a GPU, the host needs the indices of the rays
    that see highlights in mirrors and glass. Only `distances` waits for these indices, so that the caller may queue other work
    first.

    images: record of the paths. radiance: of the rays, `[3, N]`. own: distances of the primary hits, `[N]`. bright: least
    luminance of a highlight.
    """

    def __init__(self, images: ImageRecorder, radiance: Tensor, own: Tensor, bright: float):
        self._search: _Search | None = _Search(images, luminance(radiance), own, bright)
        self._distances: Tensor | None = None
        if own.device.type == "cpu":
            self.distances()

    def distances(self) -> Tensor:
        """Distance along each ray, `[N]`, at which most of its light appears to originate.

        If virtual images give more than half of the luminance, the result is the distance of the brightest image. For an image at
        infinity or behind the lens, the result is MISS_DISTANCE. Otherwise, the result is the distance of the primary hit. A ray
        that is not bright and continues in a mirror or glass gets MISS_DISTANCE.
        """
        if self._distances is None:
            assert self._search is not None
            self._distances, self._search = self._search.distances(), None
        return self._distances


class _Search:
    """Search for the virtual images in a record. Arguments: see `ImageDistances`; luminances: of the rays, `[N]`."""

    def __init__(self, images: ImageRecorder, luminances: Tensor, own: Tensor, bright: float):
        self._images, self._luminances = images, luminances
        self._own = torch.where(self._continues(own) & (luminances <= bright), MISS_DISTANCE, own)
        self._views, narrow = self._possible(luminances > bright)
        self._narrow = PendingIndices(narrow)

    def _continues(self, own: Tensor) -> Tensor:
        """Whether some path of a ray leaves the primary hit with a density above NARROW, as in a mirror or glass, bool `[N]`."""
        found, images = torch.zeros_like(own), self._images
        if images.vertices:
            scatter_add(found, images.rays(images.starts), (images.vertices[0].pdf > NARROW).to(own.dtype))
        return found > 0.0

    def _possible(self, bright: Tensor) -> tuple[list[_View], list[Tensor]]:
        """Views of the events along bright rays, and whether the path of each entry met only mirrors and glass, bool `[K]`.

        bright: bool `[N]`.
        """
        views, narrow = [], []
        for event in self._images.events:
            rays = self._images.rays(event.paths)
            entries = ActiveEntries(bright.index_select(0, rays) & (event.radiance.amax(0) > 0.0))
            path = entries.select(event.paths)
            places = [vertex.place.index_select(0, path) for vertex in event.vertices]
            views.append(_View(event, entries.select(rays), entries.index, places))
            narrow.append(entries.masked(_least_density(event, places) > NARROW, False))
        return views, narrow

    def distances(self) -> Tensor:
        """See `ImageDistances`."""
        count = len(self._own)  # the last place collects untrusted images
        distance, light, brightest = torch.zeros(3, count + 1, device=self._own.device)
        for view, index in zip(self._views, self._narrow.get()):
            if len(index) > 0:
                view = view.select(index)
                image, trusted = self._image(view)
                rays = torch.where(trusted, view.rays, count)
                added = luminance(view.event.radiance.index_select(1, view.entries))
                scatter_add(light, rays, added)
                brightest.scatter_reduce_(0, rays, added, "amax")
                distance.scatter_(0, torch.where(added == brightest.index_select(0, rays), rays, count), image)
        return torch.where(light[:-1] > 0.5 * self._luminances, distance[:-1], self._own)

    def _image(self, view: _View) -> tuple[Tensor, Tensor]:
        """Distances of the images along the rays of a view, `[K]`, and whether they are trusted."""
        device, vertices, geometry = view.rays.device, view.event.vertices, self._images.geometry
        abcd = to_device(IDENTITY, device, torch.float32)[:, None].expand(-1, len(view.rays))
        for vertex, place in zip(vertices, view.places):
            triangle = vertex.triangles(place)
            found = (vertex.outgoing, vertex.direction, vertex.front, vertex.thin, vertex.transmission, vertex.ior)
            found = (values.index_select(-1, place) for values in found)
            abcd = _propagate_through(
                abcd, vertex.distances(place), geometry.corners(triangle), geometry.corner_normals(triangle), *found
            )
        image = _image(abcd, view.event.distance.index_select(0, view.entries))
        return image, image > LEAST_SHARE * vertices[0].distances(view.places[0])


def _least_density(event: _Event, places: list[Tensor]) -> Tensor:
    """Smallest density of the directions at the vertices of an event, `[K]`; places: as in `_View`."""
    return torch.stack([vertex.pdf.index_select(0, place) for vertex, place in zip(event.vertices, places)]).amin(0)


def propagate_abcd(abcd: Tensor, distance: Tensor) -> Tensor:
    """ABCD `[5, N]` after propagation by `distance` `[N]`.

    The matrix describes two rays near the axis. The first ray starts beside the axis, and the second ray starts at an angle to
    the axis. Rows A and B are the offsets of the two rays from the axis. Rows C and D are the angles of the two rays times the
    refractive index. The fifth row is the refractive index of the medium.
    """
    return torch.cat((abcd[:2] + distance / abcd[4] * abcd[2:4], abcd[2:]))


def _image(abcd: Tensor, distance: Tensor) -> Tensor:
    """Distances `[N]` of the images of points at `distance` `[N]` beyond the last vertex of ABCD `[5, N]`.

    Images behind the lens get MISS_DISTANCE.
    """
    across, along = propagate_abcd(abcd, distance)[:2]
    place = along / torch.where(across == 0.0, SMALLEST, across)
    return torch.where(place > 0.0, place.clamp(max=MISS_DISTANCE), MISS_DISTANCE)


def _propagate_through(
    abcd: Tensor,
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
    """ABCD `[5, N]` after propagation by `distance` `[N]` and reflection or refraction at triangles."""
    abcd, incoming = propagate_abcd(abcd, distance), -outgoing
    index, solid = abcd[4], (thin == 0.0) & (transmission > 0.0)
    mirrored = dot(incoming, normals[0]) * dot(direction, normals[0]) < 0.0
    through = torch.where(solid, refraction_power(corners, normals, incoming, direction, front, ior), 0.0)
    power = torch.where(mirrored, index * mirror_power(corners, normals, incoming), through)
    beyond = torch.where(solid & ~mirrored, torch.where(front > 0.0, ior, 1.0), index)
    return torch.cat((abcd[:2], abcd[2:4] + power * abcd[:2], beyond[None]))


def mirror_power(corners: Tensor, normals: Tensor, incoming: Tensor) -> Tensor:
    """Power of mirrors, dioptres (1/m), `[N]`: 1 / distance of the image behind the mirror - 1 / distance of the object.

    The power is the mean over the two principal planes (Coddington's equations).

    corners, normals: of triangles with interpolated normals, `[3, 3, N]` each, corner first. incoming: unit directions `[3, N]`
    of arriving rays.
    """
    tangential, sagittal, cosine, _ = principal_curvatures(corners, normals, incoming)
    return tangential / cosine + sagittal * cosine


def refraction_power(corners: Tensor, normals: Tensor, incoming: Tensor, direction: Tensor, front: Tensor, ior: Tensor) -> Tensor:
    """Power `[N]` of refracting surfaces, from their mean curvature; see `mirror_power`.

    Each distance in the definition of the power is divided by the refractive index of its medium.

    direction: unit directions of the refracted rays, `[3, N]`. front: 1 where rays arrive from outside, else 0, `[N]`. ior:
    refractive index inside the surface, `[N]`.
    """
    tangential, sagittal, cosine, normal = principal_curvatures(corners, normals, incoming)
    before, beyond = torch.where(front > 0.0, 1.0, ior), torch.where(front > 0.0, ior, 1.0)
    return -0.5 * (tangential + sagittal) * (beyond * dot(normal, direction).abs() - before * cosine)


def principal_curvatures(corners: Tensor, normals: Tensor, incoming: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Curvatures `[N]` in the plane of incidence and across it, cosines `[N]` and normals `[3, N]`.

    Curvatures are positive where the surface is convex to arriving rays.
    """
    normal = normalize(normals.mean(0))
    facing = dot(normal, incoming)
    side, cosine = -torch.sign(facing), facing.abs().clamp(min=GRAZING)
    sagittal = cross(normal, incoming)
    # At normal incidence, any tangent is valid.
    upright = (dot(sagittal, sagittal) < 1e-8).to(torch.float32)
    sagittal = normalize(sagittal + upright * cross(normal, corners[1] - corners[0]))
    tangential = cross(normal, sagittal)
    return side * _curvature(corners, normals, tangential), side * _curvature(corners, normals, sagittal), cosine, normal


def _curvature(corners: Tensor, normals: Tensor, along: Tensor) -> Tensor:
    """Normal curvature `[N]` of triangles along unit tangents `[3, N]`, positive where convex on the side of the normals."""
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    base = divisor(length(first))
    first = first / base
    skew = dot(first, second)
    second = second - skew * first
    height = divisor(length(second))
    v = dot(along, second / height) / height
    u = (dot(along, first) - v * skew) / base
    return dot(along, u * (normals[1] - normals[0]) + v * (normals[2] - normals[0]))
