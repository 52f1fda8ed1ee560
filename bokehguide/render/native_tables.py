"""The tables of a scene and of its lights for the native core; `native/tables.h` names them."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.bsdf.coat_albedo import packed_brushed_table, packed_table
from bokehguide.render.bsdf.sheen import albedo_table
from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.light_clusters import LightClusters
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.render.materials import NORMAL_MAPS, SLOTS, Materials
from bokehguide.render.native_hits import surface_fields
from bokehguide.render.textures import TextureAtlas
from bokehguide.render.visibility import Visibility


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
        tables |= {"map_keep": table.keep, "map_alias": table.alias}
    if environment.distant:
        tables["distant"] = torch.stack([light.row(share) for light, share in zip(environment.distant, environment.share[1:])])
        tables["distant_edges"] = torch.as_tensor(np.cumsum(environment.share[:-1]), dtype=torch.float32)
    return tables, numbers
