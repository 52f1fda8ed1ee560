"""Polygons of meshes, refined if they are the control mesh of a subdivision surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.scene.shapes import unit_normals
from bokehguide.scene.usd.libraries import UsdGeom
from bokehguide.scene.usd.polygons import triangulate
from bokehguide.scene.usd.primvars import Primvar, Topology, read_normals
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.subdivision import Cage, Refinement, control_cage, refinement, smooth_normals

MAX_LEVEL = 3
"""Refinements of a subdivision surface."""
MOST_REFINED = 4_000_000
"""Triangles of all refined surfaces of a stage."""
MOST_QUADS = 65_536
"""Quads of one refined surface, unless a single refinement makes more."""
INFINITELY_SHARP = 10.0


@dataclass(frozen=True)
class Surface:
    """Polygons of a mesh in its own space.

    points: `[V, 3]`. control: the topology of the file, which primvars belong to. topology: that of the polygons. triangles:
    positions `[T, 3]` among the corners. faces: the polygon of the file of each triangle, `[T]`. levels: refinements of a
    subdivision surface.
    """

    points: np.ndarray
    control: Topology
    topology: Topology
    triangles: np.ndarray
    faces: np.ndarray
    normals: Primvar | None
    levels: tuple[Refinement, ...] = ()

    def of(self, primvar: Primvar) -> Primvar:
        """The values of a primvar of the file on the polygons."""
        if not self.levels or primvar.interpolation == "constant":
            return primvar
        if primvar.interpolation == "vertex":
            return Primvar(_at_vertices(self.levels, primvar.values), "vertex")
        values = self.control.at_corners(primvar)
        for level in self.levels:
            values = level.at_corners(values)
        return Primvar(values, "faceVarying")


def refinable(opened: Stage, prim: Any) -> int:
    """The corners of a Catmull-Clark mesh, 0 for another one."""
    mesh = UsdGeom.Mesh(prim)
    if mesh.GetSubdivisionSchemeAttr().Get(opened.time) != UsdGeom.Tokens.catmullClark:
        return 0
    return len(mesh.GetFaceVertexIndicesAttr().Get(opened.time) or ())


def common_level(corners: int) -> int:
    """The refinements for subdivision surfaces with so many corners in all."""
    fitting = [level for level in range(1, MAX_LEVEL + 1) if 2 * corners * 4 ** (level - 1) <= MOST_REFINED]
    return max(fitting, default=0)


def read_surface(opened: Stage, prim: Any, level: int) -> Surface | None:
    """The polygons of a mesh, None without any. level: refinements of a subdivision surface at most.

    Raises BokehguideError, naming the prim, for indices out of range.
    """
    mesh = UsdGeom.Mesh(prim)
    points, topology = _polygons(opened, mesh)
    if not topology.counts.sum():
        return None
    surface = _drawn(opened, mesh, points, topology, level)
    holes = np.asarray(mesh.GetHoleIndicesAttr().Get(opened.time) or (), np.int64)
    kept = ~np.isin(surface.faces, holes)
    triangles, faces = surface.triangles[kept], surface.faces[kept]
    if not len(triangles):
        return None
    flipped = mesh.GetOrientationAttr().Get(opened.time) == UsdGeom.Tokens.leftHanded
    triangles = triangles[:, ::-1] if flipped else triangles
    normals = surface.normals
    if flipped and surface.levels and normals is not None:
        normals = Primvar(-normals.values, normals.interpolation)
    return Surface(surface.points, topology, surface.topology, triangles, faces, normals, surface.levels)


def _polygons(opened: Stage, mesh: Any) -> tuple[np.ndarray, Topology]:
    """The points `[V, 3]` and the checked polygons of a mesh."""
    prim = mesh.GetPrim()
    points = np.asarray(mesh.GetPointsAttr().Get(opened.time) or (), np.float32).reshape(-1, 3)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(opened.time) or (), np.int64)
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(opened.time) or (), np.int64)
    if counts.min(initial=0) < 0 or counts.sum() != len(indices):
        wanted = counts.sum()
        opened.fail(prim, f"faceVertexCounts need {wanted} faceVertexIndices, but there are {len(indices)}; repair the file")
    if len(indices) and not (indices.min() >= 0 and indices.max() < len(points)):
        opened.fail(prim, f"faceVertexIndices lead out of the {len(points)} points; repair the file")
    if not np.isfinite(points).all():
        opened.fail(prim, "points are not finite; repair the file")
    return points, Topology(counts, indices, len(points))


def _drawn(opened: Stage, mesh: Any, points: np.ndarray, topology: Topology, level: int) -> Surface:
    """The surface of a mesh: its polygons, or a refinement of them."""
    scheme, name = mesh.GetSubdivisionSchemeAttr().Get(opened.time), str(mesh.GetPath())
    if scheme == UsdGeom.Tokens.catmullClark and level > 0 and topology.counts.min() >= 3:
        return _subdivided(_cage(opened, mesh, topology), points, topology, level)
    triangles, faces = triangulate(points, topology.counts, topology.indices)
    normals = read_normals(opened, mesh, topology)
    if scheme not in (UsdGeom.Tokens.none, UsdGeom.Tokens.bilinear):
        opened.lose(f"subdivision surfaces ({scheme}): drawn as their control meshes with smooth normals", name)
        if normals is None:
            normals = Primvar(unit_normals(np.zeros_like(points), points, topology.indices[triangles]), "vertex")
    return Surface(points, topology, topology, triangles, faces, normals)


def _subdivided(cage: Cage, points: np.ndarray, control: Topology, level: int) -> Surface:
    """A refined surface with smooth normals, which are split at sharp edges."""
    levels: list[Refinement] = []
    owners = np.arange(len(control.counts))
    while len(levels) < level and (not levels or 4 * len(cage.counts) <= MOST_QUADS):
        levels.append(refinement(cage))
        owners = np.repeat(owners, cage.counts)
        cage = levels[-1].refined()
    smooth = _at_vertices(levels, points)
    topology = Topology(cage.counts, cage.indices, len(smooth))
    triangles, faces = triangulate(smooth, cage.counts, cage.indices)
    if len(cage.edges):
        normals = Primvar(smooth_normals(smooth, cage), "faceVarying")
    else:
        normals = Primvar(unit_normals(np.zeros_like(smooth), smooth, cage.indices[triangles]), "vertex")
    return Surface(smooth, control, topology, triangles, owners[faces], normals, tuple(levels))


def _at_vertices(levels: Sequence[Refinement], values: np.ndarray) -> np.ndarray:
    """Values `[V0, C]` of the vertices of a control mesh, at the vertices of its refinement."""
    for level in levels:
        values = level.at_vertices(values)
    return values.astype(np.float32)


def _cage(opened: Stage, mesh: Any, topology: Topology) -> Cage:
    """The control mesh of a subdivision surface, with its creases and corners, as far as they lead to vertices."""
    cage = control_cage(topology.counts, topology.indices, topology.vertices)
    read = {name: np.asarray(getattr(mesh, f"Get{name}Attr")().Get(opened.time) or (), np.float64) for name in CREASES}
    lengths, vertices = read["CreaseLengths"].astype(np.int64), read["CreaseIndices"].astype(np.int64)
    sharpness, corners = read["CreaseSharpnesses"], cage.corners.copy()
    places = read["CornerIndices"].astype(np.int64)
    if len(places) == len(read["CornerSharpnesses"]) and _within(places, topology.vertices):
        corners[places] = np.maximum(corners[places], _sharp(read["CornerSharpnesses"]))
    edges, values = cage.edges, cage.sharpness
    if len(lengths) and lengths.min() >= 2 and lengths.sum() == len(vertices) and _within(vertices, topology.vertices):
        last = np.cumsum(lengths) - 1
        starts = np.setdiff1d(np.arange(len(vertices)), last)
        spread = np.repeat(sharpness, lengths - 1) if len(sharpness) == len(lengths) else sharpness
        if len(spread) == len(starts):
            edges = np.sort(np.stack([vertices[starts], vertices[starts + 1]], axis=1), axis=1)
            values = _sharp(spread)
    return Cage(cage.counts, cage.indices, edges, values, corners)


CREASES = ("CreaseIndices", "CreaseLengths", "CreaseSharpnesses", "CornerIndices", "CornerSharpnesses")


def _within(indices: np.ndarray, count: int) -> bool:
    return not len(indices) or bool(indices.min() >= 0 and indices.max() < count)


def _sharp(values: np.ndarray) -> np.ndarray:
    """Sharpness of 0 or more, infinite from INFINITELY_SHARP on."""
    values = np.nan_to_num(values, posinf=INFINITELY_SHARP).clip(0.0)
    return np.where(values >= INFINITELY_SHARP, np.inf, values)
