"""Where lamps that polished surfaces mirror appear to be.

A highlight on polished metal wanders over it as the point of the lens does. What stays where it is, and is as far out
of focus as the highlight looks, is the lamp's mirror image: as far behind a flat mirror as the lamp is before it,
and close behind a bulging one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import cross, dot, luminance, normalize

NARROW = 4.0
"""A BSDF that samples a direction with at least this density per steradian mirrors what lies there: GGX's α is below 0.14."""
GRAZING = 0.02
"""Cosines to the normal count as at least this."""


class MirrorImages:
    """Mirror images that N rays along unit directions `[3, N]` see in the first surfaces they meet.

    distance: along each ray, to the one of the last light that was added, in front of the mirror if it is hollow; light:
    luminance, 0 where nothing was mirrored; `[N]` both.
    """

    def __init__(self, geometry: Geometry, directions: Tensor):
        self._geometry, self._directions = geometry, directions
        self.distance, self.light = torch.zeros_like(directions[:2])

    def add(
        self, index: Tensor, triangle: Tensor, reached: Tensor, direction: Tensor, pdf: Tensor, distance: Tensor, radiance: Tensor
    ) -> None:
        """Add what some rays brought that went on from their first surface by its BSDF.

        index: which rays, int64 `[K]`; triangle, reached: their first surface and its distance; direction `[3, K]`, pdf,
        distance: in which they went on, with which density, and how far; radiance: what that brought, `[3, K]`.
        """
        light = luminance(radiance)
        narrow = ((pdf > NARROW) & (light > 0.0)).nonzero()[:, 0]
        if len(narrow) == 0:
            return
        index, triangle, reached, direction, distance, light = (
            values.index_select(-1, narrow) for values in (index, triangle, reached, direction, distance, light)
        )
        corners, normals = self._geometry.corners(triangle), self._geometry.corner_normals(triangle)
        incoming = self._directions.index_select(1, index)
        curved = 1.0 / distance + mirror_vergence(corners, normals, incoming)
        image = reached + torch.where(curved < 0.0, curved.clamp(max=-1.0 / MISS_DISTANCE), curved.clamp(min=1.0 / MISS_DISTANCE)).reciprocal()
        seen = (dot(incoming, normals[0]) * dot(direction, normals[0]) < 0.0) & (image > 0.0)
        seen = seen.nonzero()[:, 0]
        index = index.index_select(0, seen)
        self.distance.index_copy_(0, index, image.index_select(0, seen))
        self.light.index_copy_(0, index, light.index_select(0, seen))


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
    aa, ab, bb = dot(first, first), dot(first, second), dot(second, second)
    a, b = dot(along, first), dot(along, second)
    area = (aa * bb - ab * ab).clamp(min=1e-37)
    u, v = (a * bb - b * ab) / area, (b * aa - a * ab) / area
    return dot(along, u * (normals[1] - normals[0]) + v * (normals[2] - normals[0]))
