"""Meshes of a stage: polygons, primvars, subsets of faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.scene.shapes import unit_normals
from bokehguide.scene.types import Mesh
from bokehguide.scene.usd.libraries import UsdGeom
from bokehguide.scene.usd.materials import Look
from bokehguide.scene.usd.polygons import triangulate
from bokehguide.scene.usd.primvars import OF_VERTICES, Primvar, Topology, read_normals, read_primvar
from bokehguide.scene.usd.stage import Stage


@dataclass(frozen=True)
class Surface:
    """Polygons of a gprim in its own space: points `[V, 3]`, triangles as positions `[T, 3]` among the corners, and the polygon
    `[T]` of each triangle."""

    points: np.ndarray
    topology: Topology
    triangles: np.ndarray
    faces: np.ndarray
    normals: Primvar | None


def read_surface(opened: Stage, prim: Any) -> Surface | None:
    """The polygons of a mesh, None without any. Raises BokehguideError, naming the prim, for indices out of range."""
    mesh = UsdGeom.Mesh(prim)
    points = np.asarray(mesh.GetPointsAttr().Get(opened.time) or (), np.float32).reshape(-1, 3)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(opened.time) or (), np.int64)
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(opened.time) or (), np.int64)
    if not len(points) or not len(counts):
        return None
    if counts.min() < 0 or counts.sum() != len(indices):
        opened.fail(
            prim, f"faceVertexCounts need {counts.sum()} faceVertexIndices, but there are {len(indices)}; repair the file"
        )
    if len(indices) and not (indices.min() >= 0 and indices.max() < len(points)):
        opened.fail(prim, f"faceVertexIndices lead out of the {len(points)} points; repair the file")
    if not np.isfinite(points).all():
        opened.fail(prim, "points are not finite; repair the file")
    topology = Topology(counts, indices, len(points))
    triangles, faces = triangulate(points, counts, indices)
    kept = ~np.isin(faces, np.asarray(mesh.GetHoleIndicesAttr().Get(opened.time) or (), np.int64))
    triangles, faces = triangles[kept], faces[kept]
    if mesh.GetOrientationAttr().Get(opened.time) == UsdGeom.Tokens.leftHanded:
        triangles = triangles[:, ::-1]
    if not len(triangles):
        return None
    normals = read_normals(opened, mesh, topology)
    if mesh.GetSubdivisionSchemeAttr().Get(opened.time) != UsdGeom.Tokens.none:
        opened.lose("subdivision surfaces: drawn as their control meshes with smooth normals", str(prim.GetPath()))
        if normals is None:
            smooth = unit_normals(np.zeros_like(points), points, indices[triangles])
            normals = Primvar(smooth, "vertex")
    return Surface(points, topology, triangles, faces, normals)


def read_mesh(opened: Stage, prim: Any, surface: Surface, faces: np.ndarray | None, look: Look) -> Mesh:
    """The triangles of a surface in its own space, with the material index 0.

    faces: numbers of the polygons of a subset; None for all. look: names the primvars.
    """
    chosen = surface.triangles if faces is None else surface.triangles[np.isin(surface.faces, faces)]
    topology = surface.topology
    uvs = [_uvs(opened, prim, name, topology) for name in look.uv_names]
    tint = _colors(opened, prim, look.colors, topology)
    primvars = [each for each in (surface.normals, *uvs, tint) if each is not None]
    if all(each.interpolation in (*OF_VERTICES, "constant") for each in primvars):
        spread, vertices, triangles = topology.at_vertices, surface.points, topology.indices[chosen]
    else:
        spread, vertices, triangles = topology.at_corners, surface.points[topology.indices], chosen
    used, triangles = np.unique(triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3).astype(np.int32)
    vertices = vertices[used]
    normals = None if surface.normals is None else unit_normals(spread(surface.normals)[used], vertices, triangles)
    return Mesh(
        vertices=vertices,
        triangles=triangles,
        material=0,
        normals=normals,
        uvs=np.stack([spread(each)[used] * (1, -1) + (0, 1) for each in uvs], axis=1) if uvs else None,
        colors=None if tint is None else spread(tint)[used],
    )


def _uvs(opened: Stage, prim: Any, name: str, topology: Topology) -> Primvar:
    """Texture coordinates with v upwards, 0 with a note if there are none."""
    found = read_primvar(opened, prim, name, 2, topology)
    if found is None:
        opened.lose(f"textures without the primvar {name}: their corner texel is used", str(prim.GetPath()))
        return Primvar(np.zeros((1, 2), np.float32), "constant")
    return found


def _colors(opened: Stage, prim: Any, name: str, topology: Topology) -> Primvar | None:
    """Colours `[N, 4]` that are no constant; the opacity is that of `displayOpacity` for the display colour."""
    found = read_primvar(opened, prim, name, 3, topology) if name else None
    if found is None:
        return None
    rgba = np.concatenate([found.values, np.ones((len(found.values), 1), np.float32)], axis=1)
    return Primvar(rgba.clip(0.0, 1.0), found.interpolation)
