"""Whole paths in the native core: the tables of a scene for it, and its results as those of the path tracer.

`native/trace.h` does what `path_tracer.py` does. Observers that need the events of a trace are left to PyTorch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.bsdf.coat_albedo import packed_brushed_table, packed_table
from bokehguide.render.bsdf.sheen import albedo_table
from bokehguide.render.geometry import Geometry, Surface
from bokehguide.render.light_groups import GroupRadiance
from bokehguide.render.lights.base import LightSampler
from bokehguide.render.lights.light_clusters import LightClusters
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.render.materials import NORMAL_MAPS, SLOTS, Materials
from bokehguide.render.observer import CoreReport, PathObserver
from bokehguide.render.primary_hits import CoreRecord, PrimaryHits
from bokehguide.render.random import PixelRandom
from bokehguide.render.splitting import Splitting
from bokehguide.render.textures import TextureAtlas
from bokehguide.render.tracer import Hit
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
        core = native.core()
        if core is None or geometry.device.type != "cpu":
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
        """The `Views` of the extension, which `native/reuse.cpp` describes."""
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
            **_hit_arrays(count, self._geometry.materials),
            **_path_arrays(paths, lights is not None),
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
        keys = random.pixel_keys.contiguous(), core.Random(random.step_key, random.seed_key, random.index)
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


LIGHT_ROWS = ("light_row", "light_cluster", "light_rms", "light_visibility", "light_difference")
"""Arrays of the light samples of a trace: see `CoreReport.light_samples`."""
SURFACE_ROWS = (3, 3, 3, 3, 1, 1, 1, 3, 1, 1, 1, 1, 1, 1, 3, 1, 1, 3, 3, 1, 3, 1, 1, 3, 1, 1, 1, 1, 1)
"""Rows of the fields of `Surface` in the native core."""
PLAIN_FIELDS = 18
"""Fields of `Surface` before those of sheens and of the other rare terms."""


def surface_fields(materials: Materials) -> tuple[int, ...]:
    """Rows of each field of `Surface` that records of the native core hold. The last fields are rare."""
    rare = (materials.sheen, materials.anisotropy, materials.diffuse_transmission, materials.film, materials.dispersion)
    rare += (materials.single_scattering,)
    return SURFACE_ROWS[:PLAIN_FIELDS] if all(table is None for table in rare) else SURFACE_ROWS


def _hit_arrays(count: int, materials: Materials) -> dict[str, Tensor]:
    """Arrays for at most `count` primary hits, by the names of `SplitRecord` in `native/tables.h`."""
    arrays = {name: torch.empty(count, dtype=torch.int32) for name in ("ray", "triangle", "paths")}
    arrays |= {name: torch.empty(count) for name in ("distance", "u", "v")}
    return {**arrays, "surface": torch.empty(sum(surface_fields(materials)), count), "emission": torch.empty(3, count)}


def _path_arrays(count: int, with_lights: bool) -> dict[str, Tensor]:
    """Arrays for at most `count` paths that leave primary hits."""
    arrays = {name: torch.empty(3, count) for name in ("light_direction", "scattered_direction")}
    arrays |= {name: torch.empty(6, count) for name in ("reflected", "bsdf")}
    arrays["owner"] = torch.empty(count, dtype=torch.int64)
    if with_lights:
        arrays |= {name: torch.empty(count, dtype=torch.int32) for name in LIGHT_ROWS[:2]}
        arrays |= {name: torch.empty(count) for name in LIGHT_ROWS[2:]}
    return arrays


def surface_of(materials: Materials, rows: Tensor) -> Surface:
    """Surfaces from the rows `[R, K]` of the native core, without the fields that no material needs."""
    parts = [part if len(part) > 1 else part[0] for part in rows.split(surface_fields(materials))]
    values: dict[str, Any] = {field.name: part for field, part in zip(dataclasses.fields(Surface), parts)}
    if materials.specular_color is None:
        values["specular_color"] = None
    if materials.clearcoat is None:
        values |= {"clearcoat": None, "clearcoat_alpha": None}
    if not materials.tilts_coats:
        values["clearcoat_normal"] = None
    if materials.sheen is None:
        values |= {"sheen_color": None, "sheen_roughness": None}
    if materials.anisotropy is None:
        values |= {"tangent": None, "alpha_along": None}
    if materials.diffuse_transmission is None:
        values |= {"diffuse_transmission": None, "transmission_color": None}
    if materials.film is None:
        values |= {"iridescence": None, "film_ior": None, "film_thickness": None}
    if materials.dispersion is None:
        values["dispersion"] = None
    if materials.single_scattering is None:
        values["single_scattering"] = None
    return Surface(**values)


class NativeHits(PrimaryHits):
    """`PrimaryHits` that the native core has recorded.

    record: arrays of the core, of which `hits` hits and `paths` paths are in use. Tensors share the memory of the record, and are
    made when PyTorch asks for them.
    """

    def __init__(self, geometry: Geometry, record: dict[str, Tensor], hits: int, paths: int):
        self.geometry, self._record, self._hits, self._paths = geometry, record, hits, paths
        self._normals: list[Tensor] | None = None
        self._reflection = self.emits = None

    def _of_hits(self, name: str) -> Tensor:
        return self._record[name][..., : self._hits]

    def _of_paths(self, name: str) -> Tensor:
        return self._record[name][..., : self._paths]

    @cached_property
    def rays(self) -> Tensor:  # type: ignore[override]
        return self._of_hits("ray").long()

    @cached_property
    def hit(self) -> Hit:  # type: ignore[override]
        return Hit(*(self._of_hits(name) for name in ("triangle", "distance", "u", "v")))

    @cached_property
    def surface(self) -> Surface:  # type: ignore[override]
        return surface_of(self.geometry.materials, self._of_hits("surface"))

    @cached_property
    def emission(self) -> Tensor:  # type: ignore[override]
        return self._of_hits("emission")

    @cached_property
    def counts(self) -> Tensor:  # type: ignore[override]
        return self._of_hits("paths").long()

    @cached_property
    def owner(self) -> Tensor:  # type: ignore[override]
        return self._of_paths("owner")

    @cached_property
    def light_direction(self) -> Tensor:  # type: ignore[override]
        return self._of_paths("light_direction")

    @cached_property
    def scattered_direction(self) -> Tensor:  # type: ignore[override]
        return self._of_paths("scattered_direction")

    @cached_property
    def direct(self) -> Tensor:  # type: ignore[override]
        return self._of_paths("reflected")[:3]

    @cached_property
    def indirect(self) -> Tensor:  # type: ignore[override]
        return self._of_paths("reflected")[3:]

    def core_record(self) -> CoreRecord:
        """See `PrimaryHits`."""
        return CoreRecord(self._record, self._hits, self._paths)


def cluster_lights(core: ModuleType, clusters: LightClusters, arrays: dict[str, Tensor], numbers: dict[str, float]) -> object:
    """The `ClusterLights` of the extension; arrays, numbers: tiles and tables, by the names of `ClusterLights` in `tables.h`."""
    numbers = {**numbers, "clusters": clusters.count, "first_texels": clusters.triangles, "first_distant": clusters.first_distant}
    numbers["map_clusters"] = 0
    if clusters.map is not None:
        numbers["map_clusters"] = clusters.map.count
        within = clusters.map.within
        arrays = {**arrays, "texel_keep": within.keep, "texel_alias": within.alias, "texel_start": within.start}
        arrays |= {"texel_order": clusters.map.order, "texel_cluster": clusters.map.clusters}
        arrays["cluster_scale"] = clusters.map.scale
    tables = {name: table.contiguous() for name, table in arrays.items()}
    return core.ClusterLights(tables, {name: float(value) for name, value in numbers.items()})


def native_scene(core: Any, geometry: Geometry, lights: Lights, visibility: Visibility) -> Any:
    """The `Scene` of the extension, which shares the tensors of these modules; `native/tables.h` names its tables."""
    arrays: dict[str, Tensor | None] = {}
    numbers: dict[str, float] = {}
    for tables, values in (
        _geometry_tables(geometry, lights, visibility),
        _material_tables(geometry.materials),
        _texture_tables(geometry.materials.atlas),
        _emitter_tables(lights),
        _environment_tables(lights),
    ):
        arrays |= {name: None if table is None else table.contiguous() for name, table in tables.items()}
        numbers |= {name: float(value) for name, value in values.items()}
    scenes = (geometry.tracer, visibility.opaque, visibility.translucent)
    return core.Scene(arrays, numbers, *(None if tracer is None else tracer.native for tracer in scenes))


Tables = tuple[Mapping[str, Tensor | None], Mapping[str, float]]


def _geometry_tables(geometry: Geometry, lights: Lights, visibility: Visibility) -> Tables:
    tables = {f"tangents{SLOTS.index(slot)}": rows for slot, rows in geometry.tangents.items()}
    tables |= {"normals": geometry.normals, "material": geometry.material, "emitter": lights.emitter.int()}
    tables |= {"vertices": geometry.vertices, "corners": geometry.vertex_numbers}
    tables |= {"uvs": geometry.uvs, "colors": geometry.colors, "translucent_numbers": visibility.numbers}
    return tables, {}


def _material_tables(materials: Materials) -> Tables:
    numbers = {f"numbers{SLOTS.index(slot)}": row for slot, row in materials.numbers.items()}
    scales = {f"normal_scales{SLOTS.index(slot)}": materials.normal_scales.get(slot) for slot in NORMAL_MAPS}
    flags = {"emissive": materials.emissive, "tinted": materials.tinted, "is_translucent": materials.translucent}
    tables = {
        "parameters": materials.parameters,
        "emission": materials.emission,
        "specular_color": materials.specular_color,
        "coat_albedo": packed_table(),
        "brushed_albedo": None if materials.anisotropy is None else packed_brushed_table(),
        "clearcoat": materials.clearcoat,
        "sheen": materials.sheen,
        "sheen_albedo": None if materials.sheen is None else albedo_table(),
        "anisotropy": materials.anisotropy,
        "diffuse_transmission": materials.diffuse_transmission,
        "film": materials.film,
        "dispersion": materials.dispersion,
        "single_scattering": materials.single_scattering,
        "cones": materials.cones,
        "opacity": materials.opacities,
        "absorption": materials.absorption,
    }
    facts = ("tilts_coats", "has_transmission", "plain_emission")
    integers = {name: flag.int() for name, flag in flags.items()}
    known = {name: float(getattr(materials, name)) for name in facts}
    known["surface_rows"] = float(sum(surface_fields(materials)))
    return {**tables, **numbers, **scales, **integers}, known


def _texture_tables(atlas: TextureAtlas) -> Tables:
    tables = {
        "texels": atlas.texels,
        "texture_start": atlas.start,
        "texture_sizes": atlas.sizes,
        "texture_bounds": atlas.bounds,
        "texture_uv_set": atlas.uv_set,
        "texture_transforms": atlas.transforms,
        "texture_scales": atlas.scales,
    }
    return tables, {"uv_sets": len(atlas.uv_sets)}


def _emitter_tables(lights: Lights) -> Tables:
    numbers = {"has_far_power": lights.far_power > 0.0, "cluster_levels": 0}
    if lights.empty or len(lights.triangles) == 0:
        return {}, numbers
    grid = lights.grid
    low, scale, last, step = (values.flatten().float() for values in grid.box)
    tables = {
        "emitter_rows": lights.rows,
        "emitter_triangles": lights.triangles,
        "emitter_cluster": grid.cluster_of,
        "within_keep": grid.within.keep,
        "within_alias": grid.within.alias,
        "within_start": grid.within.start,
        "far_share": lights.far_share,
        "cluster_cumulative": grid.table.cumulative,
        "grid_box": torch.cat((low, scale, last, step)),
    }
    return tables, numbers | {"cluster_levels": grid.table.levels}


def _environment_tables(lights: Lights) -> Tables:
    environment = lights.environment
    tables: dict[str, Tensor | None] = {}
    names = ("has_environment", "visible_environment", "map_width", "map_height", "map_turn", "map_share")
    numbers: dict[str, float] = dict.fromkeys(names, 0.0)
    if environment is None:
        return tables, numbers
    numbers |= {"has_environment": 1.0, "visible_environment": environment.visible, "map_share": environment.share[0]}
    if environment.map is not None:
        layout = environment.map.layout
        numbers |= {"map_width": layout.width, "map_height": layout.height, "map_turn": float(layout.turn)}
        tables["map_texels"] = environment.map.texels
    if environment.sampled_map is not None:
        table = environment.sampled_map.table
        assert table is not None
        tables |= {"map_keep": table.keep, "map_alias": table.alias, "map_density": environment.sampled_map.densities}
    if environment.distant:
        tables["distant"] = torch.stack([light.row(share) for light, share in zip(environment.distant, environment.share[1:])])
        tables["distant_edges"] = torch.as_tensor(np.cumsum(environment.share[:-1]), dtype=torch.float32)
    return tables, numbers
