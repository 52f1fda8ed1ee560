"""Whole paths in the native core, with the results of the path tracer.

`native/trace.h` does what `path_tracer.py` does. Observers that need the events of a trace are left to PyTorch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry
from bokehguide.render.light_groups import GroupRadiance
from bokehguide.render.lights.base import LightSampler
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.render.native_hits import LIGHT_ROWS, NativeHits, hit_arrays, path_arrays
from bokehguide.render.native_tables import native_scene
from bokehguide.render.observer import CoreReport, PathObserver
from bokehguide.render.primary_hits import CoreRecord, PrimaryHits
from bokehguide.render.random import PixelRandom
from bokehguide.render.splitting import Splitting
from bokehguide.render.visibility import Visibility
from bokehguide.runtime import native
from bokehguide.runtime.timer import PhaseTimer

ROWS = 14
"""Rows of the results of `trace`: radiance, normal, albedo and emission, three each, distance, and alpha."""


class CoreRays(NamedTuple):
    """N camera rays to trace in the native core; for the fields, see `PathTracer.trace`."""

    origin: Tensor
    direction: Tensor
    alive: Tensor | None
    random: PixelRandom
    max_depth: int
    shadow_threshold: Tensor | None = None


class NativeTracer:
    """Traces whole paths through one scene on the CPU. Threads may call it side by side.

    `make` returns None where the native core is missing, or the scene is on another device.
    """

    def __init__(self, scene: Any, geometry: Geometry):
        self._scene, self._geometry = scene, geometry

    @staticmethod
    def make(geometry: Geometry, lights: Lights, visibility: Visibility) -> NativeTracer | None:
        core = native.core_on(geometry.device)
        if core is None:
            return None
        return NativeTracer(native_scene(core, geometry, lights, visibility), geometry)

    def knows(self, *strategies: LightSampler | Splitting | PathObserver) -> bool:
        """Whether the core is switched on, and knows all strategies of a trace."""
        return native.core() is not None and all(strategy.in_core for strategy in strategies)

    def trace(
        self,
        given: CoreRays,
        sampler: LightSampler,
        splitting: Splitting,
        observers: Sequence[PathObserver],
        timer: PhaseTimer,
        groups: GroupRadiance | None = None,
    ) -> dict[str, Any]:
        """Fields of `PathSamples` except the primary hits, which `splitting` gets (see `PathTracer.trace`), and `groups`."""
        core = native.core()
        assert core is not None
        lights = sampler.core_lights(core)
        if splitting.counts is None and lights is None and not observers:
            return self._trace(given, timer, groups)[0]
        fields, hits, report = self._trace_split(given, splitting.counts, lights, timer, groups)
        splitting.recorded(hits)
        for observer in observers:
            observer.reported(report)
        return fields

    def record(self, hits: PrimaryHits | None) -> CoreRecord | None:
        """The record of a trace's primary hits in the core, None if PyTorch has recorded them or the core is switched off."""
        if native.core() is None:
            return None
        return CoreRecord({}, 0, 0) if hits is None else hits.core_record()

    def views(
        self, arrays: dict[str, Any], numbers: dict[str, float], record: CoreRecord, first: int, pixels: Tensor | None
    ) -> Any:
        """The `Views` of the extension, which `native/reuse.cpp` describes. pixels: of the views, `[N]`, None for a span."""
        core = native.core()
        assert core is not None
        if record.hits > 0:
            arrays = {**arrays, "record": record.arrays}
        counts = {"hits": float(record.hits), "paths": float(record.paths), "first": float(first)}
        return core.Views(self._scene, arrays, numbers | counts, pixels)

    def _trace_split(
        self,
        given: CoreRays,
        counts: Tensor | None,
        lights: object | None,
        timer: PhaseTimer,
        groups: GroupRadiance | None,
    ) -> tuple[dict[str, Any], PrimaryHits | None, CoreReport]:
        """Fields of `PathSamples`, the primary hits, None without hits, and the report for observers.

        counts: number of paths of each ray, `[N]`, None for one. lights: see `LightSampler.core_lights`.
        """
        alive, count = given.alive, given.origin.shape[1]
        counts = torch.ones(count) if counts is None else counts
        paths = int((counts if alive is None else counts * (alive > 0.0)).sum(dtype=torch.float64))
        arrays = {
            "counts": counts.float().contiguous(),
            **hit_arrays(count, self._geometry.materials),
            **path_arrays(paths, lights is not None),
        }
        images = torch.empty(3, count)
        if groups is not None:
            groups.make_paths(paths)
        fields, (hits, paths) = self._trace(given, timer, groups, arrays, lights, images)
        samples = None
        if lights is not None and paths > 0:
            row, cluster, rms, visibility, difference = (arrays[name][:paths] for name in LIGHT_ROWS)
            samples = (row, cluster, rms, visibility, difference)
        recorded = NativeHits(self._geometry, arrays, hits, paths) if hits > 0 else None
        return fields, recorded, CoreReport(fields["radiance"], fields["distance"], images, samples)

    def _trace(
        self, given: CoreRays, timer: PhaseTimer, groups: GroupRadiance | None, *split: object
    ) -> tuple[dict[str, Any], tuple[int, int]]:
        """Fields of `PathSamples`, and the numbers of recorded hits and paths. split: further arguments of the core's `trace`."""
        core, count, random = native.core(), given.origin.shape[1], given.random
        assert core is not None
        rows, triangle = torch.empty(ROWS, count), torch.empty(count, dtype=torch.int32)
        alive = None if given.alive is None else given.alive.contiguous()
        threshold = None if given.shadow_threshold is None else given.shadow_threshold.contiguous()
        keys = random.pixel_keys.contiguous(), random.core_keys(core)
        rays, seconds, *recorded = self._scene.trace(
            given.origin.contiguous(),
            given.direction.contiguous(),
            alive,
            *keys,
            given.max_depth,
            rows,
            triangle,
            *split,
            groups=None if groups is None else groups.core_arrays(),
            shadow_threshold=threshold,
        )
        timer.add("tracing rays", seconds)
        fields: dict[str, Any] = dict(zip(("radiance", "normal", "albedo", "emission"), rows[:12].split(3)))
        fields |= {"distance": rows[12], "alpha": rows[13], "triangle": triangle, "rays": rays}
        return fields, (recorded[0], recorded[1])
