"""Meshes of a stage: the triangles of a material, with their primvars."""

from __future__ import annotations

from typing import Any

import numpy as np

from bokehguide.scene.shapes import unit_normals
from bokehguide.scene.types import Mesh
from bokehguide.scene.usd.materials import Look
from bokehguide.scene.usd.primvars import OF_VERTICES, Primvar, Topology, read_primvar
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.surfaces import Surface
from bokehguide.scene.uvs import turned_uvs


def read_mesh(opened: Stage, prim: Any, surface: Surface, faces: np.ndarray | None, look: Look) -> Mesh:
    """The triangles of a surface in its own space, with the material index 0.

    faces: numbers of the polygons of a subset; None for all. look: names the primvars.
    """
    chosen = surface.triangles if faces is None else surface.triangles[np.isin(surface.faces, faces)]
    topology = surface.topology
    uvs = [surface.of(_uvs(opened, prim, name, surface.control)) for name in look.uv_names]
    tint = _colors(opened, prim, look.colors, surface.control)
    tint = None if tint is None else surface.of(tint)
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
        uvs=np.stack([turned_uvs(spread(each)[used]) for each in uvs], axis=1) if uvs else None,
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
    """Colours `[N, 4]` of a primvar, with opacity 1; None without the primvar."""
    found = read_primvar(opened, prim, name, 3, topology) if name else None
    if found is None:
        return None
    rgba = np.concatenate([found.values, np.ones((len(found.values), 1), np.float32)], axis=1)
    return Primvar(rgba.clip(0.0, 1.0), found.interpolation)
