"""Primary hits that the native core has recorded: the arrays that the core fills, and the tensors of `PrimaryHits` in them."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from bokehguide.render.geometry import Geometry
from bokehguide.render.materials import Materials
from bokehguide.render.primary_hits import CoreRecord, PrimaryHits
from bokehguide.render.surface import Surface
from bokehguide.render.tracer import Hit

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


def hit_arrays(count: int, materials: Materials) -> dict[str, Tensor]:
    """Arrays `[count]` or `[rows, count]` for at most `count` primary hits, by name as in `SplitRecord` of `native/tables.h`."""
    arrays = {name: torch.empty(count, dtype=torch.int32) for name in ("ray", "triangle", "paths")}
    arrays |= {name: torch.empty(count) for name in ("distance", "u", "v")}
    return {**arrays, "surface": torch.empty(sum(surface_fields(materials)), count), "emission": torch.empty(3, count)}


def path_arrays(count: int, with_lights: bool) -> dict[str, Tensor]:
    """Arrays `[count]` or `[rows, count]` for at most `count` paths that leave primary hits."""
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
