"""Primvars of a prim: values for its faces, vertices or corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.scene.usd.libraries import UsdGeom
from bokehguide.scene.usd.stage import Stage

OF_VERTICES = ("vertex", "varying")


@dataclass(frozen=True)
class Primvar:
    """Values `[N, C]` of an attribute, and how they belong to a mesh: "constant", "uniform", "vertex", "varying" or
    "faceVarying"."""

    values: np.ndarray
    interpolation: str


@dataclass(frozen=True)
class Topology:
    """Polygons of a mesh. counts: corners of each, `[F]`. indices: the vertex of each corner, `[I]`. vertices: their number."""

    counts: np.ndarray
    indices: np.ndarray
    vertices: int

    def size(self, interpolation: str) -> int:
        """The number of values that an interpolation needs."""
        sizes = {"constant": 1, "uniform": len(self.counts), "faceVarying": len(self.indices)}
        return sizes.get(interpolation, self.vertices)

    def at_corners(self, primvar: Primvar) -> np.ndarray:
        """The values of each corner, `[I, C]`."""
        if primvar.interpolation == "faceVarying":
            return primvar.values
        if primvar.interpolation == "uniform":
            return np.repeat(primvar.values, self.counts, axis=0)
        if primvar.interpolation == "constant":
            return np.broadcast_to(primvar.values, (len(self.indices), primvar.values.shape[1]))
        return primvar.values[self.indices]

    def at_vertices(self, primvar: Primvar) -> np.ndarray:
        """The values of each vertex, `[V, C]`, of a primvar that is constant or of vertices."""
        return np.broadcast_to(primvar.values, (self.vertices, primvar.values.shape[1]))


def read_primvar(opened: Stage, prim: Any, name: str, width: int, topology: Topology) -> Primvar | None:
    """The primvar `name` of a prim or of one above it, with `width` numbers each. None, with a note, if it does not fit."""
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    values = _numbers(primvar.ComputeFlattened(opened.time), width)
    return _fitting(opened, prim, name, values, str(primvar.GetInterpolation()), topology)


def read_normals(opened: Stage, mesh: Any, topology: Topology) -> Primvar | None:
    """The normals of a mesh; `primvars:normals` come before `normals`."""
    prim = mesh.GetPrim()
    found = read_primvar(opened, prim, "normals", 3, topology)
    if found is None and mesh.GetNormalsAttr().HasValue():
        values = _numbers(mesh.GetNormalsAttr().Get(opened.time), 3)
        found = _fitting(opened, prim, "normals", values, str(mesh.GetNormalsInterpolation()), topology)
    return found


def _numbers(values: Any, width: int) -> np.ndarray | None:
    """Values as float32 `[N, width]`, None for others."""
    if values is None:
        return None
    try:
        array = np.asarray(values, np.float32)
    except (TypeError, ValueError):
        return None
    if array.ndim == 1 and (width == 1 or array.shape == (width,)):
        array = array.reshape(-1, width)
    return array[:, :width] if array.ndim == 2 and array.shape[1] >= width else None


def _fitting(
    opened: Stage, prim: Any, name: str, values: np.ndarray | None, interpolation: str, topology: Topology
) -> Primvar | None:
    """The primvar, or None with a note if its values are no numbers or too few for its interpolation."""
    size = topology.size(interpolation)
    if values is None or len(values) < size:
        opened.lose(f"primvar {name}: left out, as its values do not fit the mesh", str(prim.GetPath()))
        return None
    return Primvar(values[:size], interpolation)
