"""Where lamps that polished surfaces mirror, or that glass lets through, appear to be.

A highlight on polished metal wanders over it as the point of the lens does. What stays where it is, and is as far out
of focus as the highlight looks, is the lamp's image: as far behind a flat mirror as the lamp is before it, close behind a
bulging one, and in the focus of a ball of glass. It is found by matrix optics: paths that go on from the eye in mirrors
and glass alone take along how a narrow pencil of rays about them spreads.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry, Surface
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import increase, indices, put
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.vector import cross, dot, length, luminance, normalize

NARROW = 4.0
"""A BSDF that samples a direction with at least this density per steradian shows what lies there: GGX's α is below 0.14."""
GRAZING = 0.02
"""Cosines to the normal count as at least this."""


class Images:
    """What N rays see in mirrors and glass.

    distance: along each ray, to the image of the brightest light, MISS_DISTANCE where it is at infinity or behind the eye; light:
    luminance of all that was seen so; `[N]` both.
    """

    def __init__(self, geometry: Geometry, count: int, device: torch.device):
        self._geometry = geometry
        self.distance, self.light, self._brightest = torch.zeros(3, count, device=device)
        self._rays: Tensor | None = None
        self._pencils = self._triangle = torch.zeros(4, 0, device=device)

    def begin(self, triangle: Tensor, distance: Tensor, rays: Tensor | None = None) -> None:
        """Paths have come to their first surfaces, whose triangles and distances are told of all rays, `[N]`.

        rays: which of them each path belongs to, int64 `[P]`; None where there is one for each.
        """
        self._rays = rays
        if rays is not None:
            triangle, distance = triangle.index_select(0, rays), distance.index_select(0, rays)
        one = torch.ones_like(distance)
        self._pencils, self._triangle = torch.stack((one, distance, 0.0 * one, one)), triangle.clone()

    def arrive(self, index: Tensor, hit: Hit, surface: Surface) -> None:
        """Some paths, int64 `[K]`, have come to their next surfaces; a way through glass is shorter by its index."""
        place = self._shown(index)
        if len(place) == 0:
            return
        index, distance, triangle, front, thin, ior = (
            values.index_select(0, place)
            for values in (index, hit.distance, hit.triangle, surface.front, surface.thin, surface.ior)
        )
        way = distance / torch.where((front > 0.0) | (thin > 0.0), 1.0, ior)
        put(self._pencils, index, _after(self._pencils.index_select(1, index), way))
        put(self._triangle, index, triangle)

    def leave(self, index: Tensor, surface: Surface, direction: Tensor, pdf: Tensor) -> None:
        """Some paths leave their surfaces in directions `[3, K]` of which the BSDF samples have this density `[K]`."""
        narrow = self._shown(index, pdf > NARROW)
        bent = self._bent(index, narrow, surface, direction)
        self._pencils[0].index_fill_(0, index, torch.nan)
        put(self._pencils, index.index_select(0, narrow), bent)

    def add_sampled(
        self, index: Tensor, surface: Surface, direction: Tensor, pdf: Tensor, distance: Tensor, radiance: Tensor
    ) -> None:
        """Add what light samples bring from there; pdf: with which density the BSDF samples their directions, as in `leave`."""
        light = luminance(radiance)
        narrow = self._shown(index, (pdf > NARROW) & (light > 0.0))
        bent = self._bent(index, narrow, surface, direction)
        self._add(*(values.index_select(0, narrow) for values in (index, distance, light)), bent)

    def add(self, index: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """Add what some paths, int64 `[K]`, brought from where they came to: `[K]` from the last surface, `[3, K]`."""
        light = luminance(radiance)
        shown = self._shown(index, light > 0.0)
        index, distance, light = (values.index_select(0, shown) for values in (index, distance, light))
        self._add(index, distance, light, self._pencils.index_select(1, index))

    def _shown(self, index: Tensor, among: Tensor | None = None) -> Tensor:
        """Which of the paths, of some of them, have met mirrors and glass alone, int64."""
        shown = self._pencils[0].index_select(0, index).isfinite()
        return indices(shown if among is None else shown & among)

    def _bent(self, index: Tensor, narrow: Tensor, surface: Surface, direction: Tensor) -> Tensor:
        """Pencils `[4, K]` of the `narrow` ones of paths when they have left their surfaces."""
        index, direction = index.index_select(0, narrow), direction.index_select(1, narrow)
        incoming = -surface.outgoing.index_select(1, narrow)
        triangle = self._triangle.index_select(0, index)
        corners, normals = self._geometry.corners(triangle), self._geometry.corner_normals(triangle)
        front, thin, ior = (values.index_select(0, narrow) for values in (surface.front, surface.thin, surface.ior))
        return _bend(self._pencils.index_select(1, index), corners, normals, incoming, direction, front, thin, ior)

    def _add(self, index: Tensor, distance: Tensor, light: Tensor, pencils: Tensor) -> None:
        if len(index) == 0:
            return
        if self._rays is not None:
            index = self._rays.index_select(0, index)
        image = _image(pencils, distance)
        increase(self.light, index, light)
        self._brightest.scatter_reduce_(0, index, light, "amax")
        first = light == self._brightest.index_select(0, index)
        put(self.distance, index[first], image[first])


def _after(pencils: Tensor, distance: Tensor) -> Tensor:
    """Pencils `[4, N]` further on. Rows: how far from their middle, and at which angle by the medium's index, rays are that began
    there beside it, and under an angle to it: A, C and B, D of matrix optics, in the order A, B, C, D."""
    return torch.cat((pencils[:2] + distance * pencils[2:], pencils[2:]))


@kernel
def _image(pencils: Tensor, distance: Tensor) -> Tensor:
    """Where what lies so far on `[N]` is seen."""
    across, along = _after(pencils, distance)[:2]
    place = along / torch.where(across == 0.0, 1e-37, across)
    return torch.where(place > 0.0, place.clamp(max=MISS_DISTANCE), MISS_DISTANCE)


@kernel
def _bend(
    pencils: Tensor,
    corners: Tensor,
    normals: Tensor,
    incoming: Tensor,
    direction: Tensor,
    front: Tensor,
    thin: Tensor,
    ior: Tensor,
) -> Tensor:
    """Pencils that triangles mirror or let through."""
    mirrored = dot(incoming, normals[0]) * dot(direction, normals[0]) < 0.0
    refracted = refraction_vergence(corners, normals, incoming, direction, front, ior) * (1.0 - thin)
    vergence = torch.where(mirrored, mirror_vergence(corners, normals, incoming), refracted)
    return torch.cat((pencils[:2], pencils[2:] + vergence * pencils[:2]))


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
