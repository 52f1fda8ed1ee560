"""What rays meet where some surfaces let light through: alpha masks and blended sheets.

Embree knows triangles only. Rays that scatter are sent on from a sheer surface by chance,
1 - opacity of them; shadow rays go through all of them and are dimmed.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bokehguide.render import triangles
from bokehguide.render.geometry import Geometry, leaving_distance
from bokehguide.render.pixels import indices
from bokehguide.render.random import PixelRandom
from bokehguide.render.tracer import Hit, Tracer
from bokehguide.scene.types import Mesh

MAX_CROSSINGS = 256
"""A ray that went through this many surfaces stops at the next one."""
SHORT = 1.0 / 16.0
"""Beyond a sheer surface rays start this much nearer to it than scattered ones: a wall may be close behind a decal."""


class Opacity:
    """Nearest surfaces and transmittance along batches of rays. Threads may call it side by side.

    A scene of opaque materials is traced as it is.
    """

    def __init__(self, geometry: Geometry, meshes: tuple[Mesh, ...]):
        self._geometry = geometry
        sheer = geometry.materials.sheer.tolist()
        self._opaque, self._sheer = geometry.tracer, None
        if geometry.materials.has_sheer:
            self._opaque, _ = _part(meshes, [not sheer[mesh.material] for mesh in meshes])
            self._sheer, numbers = _part(meshes, [sheer[mesh.material] for mesh in meshes])
            self._numbers = torch.from_numpy(numbers).to(geometry.device)

    def nearest(self, origins: Tensor, directions: Tensor, random: PixelRandom, dimension: int) -> tuple[Hit, int]:
        """Surfaces that rays `[3, N]` stop at, and the number of rays traced.

        Surface by surface the rays use up one random dimension from `dimension` on.
        Distances are from the origins.
        """
        tracer, geometry = self._geometry.tracer, self._geometry
        hit = tracer.intersect(origins, directions)
        rays = origins.shape[1]
        if self._sheer is None:
            return hit, rays
        index = torch.arange(rays, device=origins.device)
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
            found = tracer.intersect(origin, directions[:, index])
            rays += len(index)
            for field, value in zip(hit, found._replace(distance=found.distance + start)):
                field[index] = value
        return hit, rays

    def transmittance(self, origins: Tensor, directions: Tensor, distances: Tensor) -> tuple[Tensor, int]:
        """Share of the light `[N]` that comes through within `distances` `[N]` of rays `[3, N]`, and rays traced."""
        rays = origins.shape[1]
        share = torch.ones_like(distances)
        if self._opaque is not None:
            share = self._opaque.visible(origins, directions, distances)
        if self._sheer is None:
            return share, rays
        index = indices(share > 0.0)
        start, origin = torch.zeros_like(distances[index]), origins[:, index]
        last = torch.full_like(index, -1)
        for _ in range(MAX_CROSSINGS):
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
        return share, rays


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
