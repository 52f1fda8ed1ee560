"""Nearest hits and occlusion by Embree, for rays in `[3, N]` tensors."""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from torch import Tensor

from bokehguide.runtime import native
from bokehguide.runtime.device import to_device, to_host
from bokehguide.runtime.workers import Workers
from bokehguide.stopping import default_signals

log = logging.getLogger(__name__)

MISS_DISTANCE = 1e37
"""Distance of rays that hit nothing, metres."""
PART = 4096
"""Least rays of a part that one thread traces."""


class Hit(NamedTuple):
    """Nearest hits of N rays, `[N]` each. triangle: int32, -1 for a miss; u, v: weights of vertices 1 and 2."""

    triangle: Tensor
    distance: Tensor
    u: Tensor
    v: Tensor


class Tracer:
    """A static Embree scene of one triangle mesh. Threads may call its methods concurrently.

    vertices: finite, float32 `[V, 3]`. triangles: int32 `[T, 3]`. Raises ValueError for other shapes and for invalid indices.
    embreex does not check shapes and indices, and Embree would read and write beyond short arrays.

    A NaN or infinite ray hits nothing. native: the scene of the native core, None without the core.

    threads: number of threads that trace the rays of one call. 1 suits callers that call the tracer from several threads.
    """

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray, threads: int = 1):
        for name, array, kind in (("vertices", vertices, np.float32), ("triangles", triangles, np.int32)):
            if array.ndim != 2 or array.shape[1] != 3 or array.dtype != kind:
                raise ValueError(f"{name} must be {kind.__name__} [N, 3], not {array.dtype} {list(array.shape)}")
        if len(triangles) == 0 or triangles.min() < 0 or triangles.max() >= len(vertices):
            raise ValueError(f"triangle indices must lie in [0, {len(vertices)}) and be at least one triangle")
        if not np.isfinite(vertices).all():
            raise ValueError("vertices must be finite")
        self.threads = threads
        self._workers = Workers(threads, torch.device("cpu"))
        log.info("building the tracing structure of %s triangles", f"{len(triangles):,}")
        vertices, triangles, core = np.ascontiguousarray(vertices), np.ascontiguousarray(triangles), native.core()
        self.native = None if core is None else core.Triangles(vertices, triangles)
        if self.native is None:
            with default_signals():  # embreex holds the interpreter's lock
                self._scene = EmbreeScene(robust=True)
                self._mesh = TriangleMesh(self._scene, vertices, triangles)
                far = np.full((1, 3), 1e30, np.float32)
                self._scene.run(far, np.ones((1, 3), np.float32))  # commits, before any thread does

    def intersect(self, origins: Tensor, directions: Tensor, limits: Tensor | None = None) -> Hit:
        """Nearest hits of rays `[3, N]` within distances `limits` `[N]`. A miss has the limit, or MISS_DISTANCE."""
        _check_rays(origins, directions, limits)
        rays = to_host(origins, directions, *(() if limits is None else (limits,)))
        return Hit(*(to_device(values, origins.device) for values in self._in_parts(self._nearest, rays)))

    def visible(self, origins: Tensor, directions: Tensor, distances: Tensor) -> Tensor:
        """1 where rays `[3, N]` hit nothing within `distances` `[N]`, else 0; float32 `[N]`."""
        _check_rays(origins, directions, distances)
        (passes,) = self._in_parts(self._visible, to_host(origins, directions, distances))
        return to_device(passes, origins.device)

    def _in_parts(self, work: Callable[..., tuple[Tensor, ...]], rays: list[Tensor]) -> tuple[Tensor, ...]:
        """Results `[N]` of `work` for the rows `[.., N]` of rays on the host, computed in parts by the threads."""
        count = rays[0].shape[-1]
        parts = min(self.threads, count // PART)
        if parts < 2:
            return work(*(rows.contiguous() for rows in rays))
        bounds = [count * part // parts for part in range(parts + 1)]
        spans = [slice(first, last) for first, last in pairwise(bounds)]
        found = self._workers.map(lambda span: work(*(rows[..., span].contiguous() for rows in rays)), spans)
        return tuple(torch.cat(values) for values in zip(*found))

    def _nearest(self, origin: Tensor, direction: Tensor, limit: Tensor | None = None) -> tuple[Tensor, ...]:
        """The fields of `Hit`. Embree reads contiguous rows without a copy."""
        if self.native is not None:
            triangle, found = torch.empty(origin.shape[1], dtype=torch.int32), torch.empty(3, origin.shape[1])
            self.native.nearest(origin, direction, limit, triangle, found)
            return triangle, *found
        distance = None if limit is None else limit.numpy().copy()  # Embree writes into it
        found = self._scene.run(origin.numpy().T, direction.numpy().T, dists=distance, output=True)
        return tuple(torch.as_tensor(found[key]) for key in ("primID", "tfar", "u", "v"))

    def _visible(self, origin: Tensor, direction: Tensor, distance: Tensor) -> tuple[Tensor, ...]:
        """One row: 1 for rays that hit nothing, else 0."""
        if self.native is not None:
            passes = torch.empty(len(distance))
            self.native.visible(origin, direction, distance, passes)
            return (passes,)
        blocked = self._scene.run(origin.numpy().T, direction.numpy().T, dists=distance.numpy(), query="OCCLUDED")
        return (torch.as_tensor(blocked).neg().to(torch.float32),)


def _check_rays(origins: Tensor, directions: Tensor, limits: Tensor | None) -> None:
    """Raise ValueError unless the arguments are float32 `[3, N]`, `[3, N]` and `[N]` with the same N."""
    count = origins.shape[-1] if origins.ndim else 0
    given = {"origins": (origins, (3, count)), "directions": (directions, (3, count)), "limits": (limits, (count,))}
    for name, (tensor, shape) in given.items():
        if tensor is not None and (tensor.shape != shape or tensor.dtype != torch.float32):
            raise ValueError(f"{name} must be float32 {list(shape)}, not {tensor.dtype} {list(tensor.shape)}")
