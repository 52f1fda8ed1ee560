"""Where lamps that polished surfaces mirror appear to be.

A highlight on polished metal wanders over it as the point of the lens does. What stays where it is, and is as far out
of focus as the highlight looks, is the lamp's mirror image: as far behind a flat mirror as the lamp is before it,
and close behind a bulging one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry
from bokehguide.render.pixels import increase, indices, put
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import cross, dot, length, luminance, normalize

NARROW = 4.0
"""A BSDF that samples a direction with at least this density per steradian mirrors what lies there: GGX's α is below 0.14."""
GRAZING = 0.02
"""Cosines to the normal count as at least this."""


class MirrorImages:
    """Mirror images that N rays see in the first surfaces they meet.

    directions: the rays', unit, `[3, N]`; triangle, reached: their first surfaces, int32, and the distances to them, `[N]`,
    which may be written later. distance: along each ray, to that of the brightest light, MISS_DISTANCE where it is at infinity or behind the eye; light:
    luminance of all that was mirrored; `[N]` both.
    """

    def __init__(self, geometry: Geometry, directions: Tensor, triangle: Tensor, reached: Tensor):
        self._geometry, self._directions, self._triangle, self._reached = geometry, directions, triangle, reached
        self.distance, self.light, self._brightest = torch.zeros_like(directions)
        self._rays: Tensor | None = None

    def split(self, rays: Tensor) -> None:
        """From now on what is added is of paths, each of which belongs to one of `rays`, int64 `[P]`."""
        self._rays = rays

    def add(self, index: Tensor, direction: Tensor, pdf: Tensor, distance: Tensor, radiance: Tensor) -> None:
        """Add what some rays brought from beyond their first surface.

        index: which rays, or paths, int64 `[K]`; direction `[3, K]`, distance: where the light was from there; pdf: with which
        density the BSDF samples that direction, `[K]`; radiance: what it brought, `[3, K]`.
        """
        light = luminance(radiance)
        narrow = indices((pdf > NARROW) & (light > 0.0))
        if len(narrow) == 0:
            return
        index, direction, distance, light = (v.index_select(-1, narrow) for v in (index, direction, distance, light))
        if self._rays is not None:
            index = self._rays.index_select(0, index)
        triangle, reached = (values.index_select(0, index) for values in (self._triangle, self._reached))
        corners, normals = self._geometry.corners(triangle), self._geometry.corner_normals(triangle)
        incoming = self._directions.index_select(1, index)
        vergence = 1.0 / distance + mirror_vergence(corners, normals, incoming)
        behind = reached + 1.0 / torch.where(vergence < 0.0, vergence.clamp(max=-1e-37), vergence.clamp(min=1e-37))
        image = torch.where(behind > 0.0, behind.clamp(max=MISS_DISTANCE), MISS_DISTANCE)
        light = light * (dot(incoming, normals[0]) * dot(direction, normals[0]) < 0.0)  # none through glass
        increase(self.light, index, light)
        self._brightest.scatter_reduce_(0, index, light, "amax")
        first = (light == self._brightest.index_select(0, index)) & (light > 0.0)
        put(self.distance, index[first], image[first])


def mirror_vergence(corners: Tensor, normals: Tensor, incoming: Tensor) -> Tensor:
    """How much nearer mirrors bring what they show, `[N]`, in dioptres (1/m): the inverse distance of an image behind the
    mirror less that of what is before it, on average over the two principal planes (Coddington's equations).

    corners, normals: of triangles, whose normals are interpolated, `[3, 3, N]` each, corner first; incoming: unit
    directions `[3, N]` in which rays arrive.
    """
    normal = normalize(normals.mean(0))
    facing = dot(normal, incoming)
    side, cosine = -torch.sign(facing), facing.abs().clamp(min=GRAZING)
    sagittal = cross(normal, incoming)
    # Straight on, any direction along the surface will do.
    upright = (dot(sagittal, sagittal) < 1e-8).to(torch.float32)
    sagittal = normalize(sagittal + upright * cross(normal, corners[1] - corners[0]))
    tangential = cross(normal, sagittal)
    return side * (_curvature(corners, normals, tangential) / cosine + _curvature(corners, normals, sagittal) * cosine)


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
