"""Shapes of Mitsuba as meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from trimesh import Trimesh

from bokehguide.errors import BokehguideError, reason
from bokehguide.limits import MAX_INT
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.mesh_files import load_mesh_file
from bokehguide.scene.mitsuba_xml.tree import Plugin, file_of, mitsuba
from bokehguide.scene.shapes import (
    facing_normals,
    reversed_mesh,
    transform,
    transformed,
    tube,
    unit_disc,
    unit_normals,
    unit_rectangle,
    unit_sphere,
)
from bokehguide.scene.types import Mesh
from bokehguide.scene.uvs import turned_uvs


def read_shape(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh] | None:
    """The meshes of a shape in world space, None for a kind without a counterpart. Raises BokehguideError for a damaged file."""
    if shape.type in MODELS:
        meshes = MODELS[shape.type](shape, file, files)
    elif shape.type in PRIMITIVES:
        meshes = [transformed(PRIMITIVES[shape.type](shape), shape.matrix())]
    else:
        return None
    if shape.flag("face_normals"):
        meshes = [replace(mesh, normals=None) for mesh in meshes]
    # Mitsuba turns spheres inside out by a reflection.
    inside_out = shape.type == "sphere" and _mirrors(shape)
    return [reversed_mesh(mesh) for mesh in meshes] if shape.flag("flip_normals") != inside_out else meshes


def _mirrors(shape: Plugin) -> bool:
    """Whether the transform of a shape is a reflection."""
    return bool(np.linalg.det(shape.matrix()[:3, :3]) < 0.0)


def _sphere(shape: Plugin) -> Mesh:
    center = shape.vector("center", (0.0, 0.0, 0.0))
    # v grows from +z, and u about z from +x.
    pole = np.array([[0.0, 0.0, -1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return transformed(unit_sphere(), transform(center, scale=max(shape.number("radius", 1.0), 1e-9)) @ pole)


def _rectangle(shape: Plugin) -> Mesh:
    """The square, whose texture stands on its head."""
    return _turned(unit_rectangle())


def _disk(shape: Plugin) -> Mesh:
    """The disc with polar uvs: u is the radius, v the angle. Each triangle has its own corner in the middle."""
    disc = unit_disc()
    points = disc.vertices[disc.triangles]
    angle = (np.arange(len(points))[:, None] + (0.5, 0.0, 1.0)) / len(points)
    uvs = np.stack((np.linalg.norm(points, axis=2).clip(max=1.0), angle), axis=2)
    triangles = np.arange(3 * len(points), dtype=np.int32).reshape(-1, 3)
    return Mesh(points.reshape(-1, 3), triangles, 0, uvs=uvs.reshape(-1, 1, 2).astype(np.float32))


def _cylinder(shape: Plugin) -> Mesh:
    """The side of a cylinder from `p0` to `p1`: u is the angle, v the height."""
    bottom = shape.vector("p0", (0.0, 0.0, 0.0))
    axis = shape.vector("p1", (0.0, 0.0, 1.0)) - bottom
    if not np.linalg.norm(axis) > 0.0:
        shape.fail("p1", "is p0; give another point")
    with mitsuba(shape.place) as mi:
        sides = np.array(mi.coordinate_system(mi.ScalarVector3f(*(axis / np.linalg.norm(axis)))), np.float64)
    unit = _turned(transformed(tube(1.0, 1.0, 1.0), transform((0.0, 0.0, 0.5))))
    matrix, radius = np.eye(4), max(shape.number("radius", 1.0), 1e-9)
    matrix[:3] = np.stack((radius * sides[0], radius * sides[1], axis, bottom), axis=1)
    return transformed(unit, matrix)


def _cube(shape: Plugin) -> Mesh:
    with mitsuba(shape.place) as mi:
        return _mesh(mi.load_dict({"type": "cube"}))


def _obj(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh]:
    """The triangles of an `.obj` file, whose v points upwards unless the shape says otherwise."""
    meshes = [_shaded(mesh, shape) for mesh in load_mesh_file(file_of(shape, file, files, "model"), files).meshes]
    return meshes if shape.flag("flip_tex_coords", True) else [_turned(mesh) for mesh in meshes]


def _turned(mesh: Mesh) -> Mesh:
    """A mesh whose v runs the other way."""
    return mesh if mesh.uvs is None else replace(mesh, uvs=turned_uvs(mesh.uvs))


def _shaded(mesh: Mesh, shape: Plugin) -> Mesh:
    """A mesh of an `.obj` file in world space. Its front is the side of its normals.

    Without normals, triangles are anticlockwise in world space, and Mitsuba weights the normals of faces by their angle.
    """
    flat = shape.flag("face_normals")
    placed = transformed(facing_normals(replace(mesh, material=0, normals=None if flat else mesh.normals)), shape.matrix())
    if placed.normals is not None:
        return placed
    placed = reversed_mesh(placed) if _mirrors(shape) else placed
    if flat:
        return placed
    normals = Trimesh(placed.vertices, placed.triangles, process=False).vertex_normals.astype(np.float32)
    return replace(placed, normals=unit_normals(normals, placed.vertices, placed.triangles))


def _by_mitsuba(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh]:
    """The triangles of a `.ply` file or of Mitsuba's own format, read by Mitsuba. trimesh leaves out the uvs of `.ply` files."""
    path = file_of(shape, file, files, "model")
    files.add_file(path)
    values = {"type": shape.type, "filename": str(path), "face_normals": shape.flag("face_normals")}
    if shape.type == "ply":
        values["flip_tex_coords"] = shape.flag("flip_tex_coords")
    else:
        values["shape_index"] = int(shape.number("shape_index", 0))
    with mitsuba(shape.place) as mi:
        try:
            mesh = mi.load_dict(values | {"to_world": mi.ScalarTransform4f(shape.matrix())})
        except (RuntimeError, ValueError) as error:
            raise BokehguideError(f"{path}: not a readable model ({reason(error)})") from None
        return [facing_normals(_mesh(mesh))]


def _mesh(mesh: Any) -> Mesh:
    """A mesh of Mitsuba."""
    vertices = np.array(mesh.vertex_positions_buffer(), np.float32).reshape(-1, 3)
    triangles = np.array(mesh.faces_buffer(), np.int64).reshape(-1, 3)
    normals = np.array(mesh.vertex_normals_buffer(), np.float32).reshape(-1, 3) if mesh.has_vertex_normals() else None
    uvs = np.array(mesh.vertex_texcoords_buffer(), np.float32).reshape(-1, 1, 2) if mesh.has_vertex_texcoords() else None
    normals = None if normals is None else unit_normals(normals, vertices, triangles)
    return Mesh(vertices, np.minimum(triangles, MAX_INT).astype(np.int32), 0, normals, uvs)


PRIMITIVES: dict[str, Callable[[Plugin], Mesh]] = {
    "sphere": _sphere,
    "cube": _cube,
    "cylinder": _cylinder,
    "rectangle": _rectangle,
    "disk": _disk,
}
"""Makers of shapes by the name of the plugin, before their transform."""
MODELS: dict[str, Callable[[Plugin, Path, SceneFiles], list[Mesh]]] = {
    "obj": _obj,
    "ply": _by_mitsuba,
    "serialized": _by_mitsuba,
}
"""Readers of files by the name of the plugin, in world space."""
