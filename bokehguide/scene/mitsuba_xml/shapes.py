"""Shapes of Mitsuba as meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError, reason
from bokehguide.limits import MAX_INT
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.mesh_files import load_mesh_file
from bokehguide.scene.mitsuba_xml.tree import Plugin, mitsuba
from bokehguide.scene.shapes import transform, transformed, unit_disc, unit_normals, unit_rectangle, unit_sphere
from bokehguide.scene.types import Mesh


def read_shape(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh] | None:
    """The meshes of a shape in world space, None for a kind without a counterpart. Raises BokehguideError for a damaged file."""
    read = READERS.get(shape.type)
    if read is None:
        return None
    meshes = [transformed(mesh, shape.matrix()) for mesh in read(shape, file, files)]
    if shape.flag("face_normals"):
        meshes = [replace(mesh, normals=None) for mesh in meshes]
    if shape.flag("flip_normals"):
        meshes = [_flipped(mesh) for mesh in meshes]
    return meshes


def _flipped(mesh: Mesh) -> Mesh:
    """The same triangles, facing the other side."""
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, triangles=np.ascontiguousarray(mesh.triangles[:, ::-1]), normals=normals)


def _sphere(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh]:
    center = shape.values.get("center", (0.0, 0.0, 0.0))
    if not isinstance(center, tuple) or len(center) != 3:
        shape.fail("center", "is no point; give x, y and z")
    # v grows from +z, and u about z from +x.
    pole = np.array([[0.0, 0.0, -1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return [transformed(unit_sphere(), transform(center, scale=max(shape.number("radius", 1.0), 1e-9)) @ pole)]


def _rectangle(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh]:
    """The square, whose texture stands on its head."""
    square = unit_rectangle()
    assert square.uvs is not None
    return [replace(square, uvs=square.uvs * np.array((1.0, -1.0), np.float32) + np.array((0.0, 1.0), np.float32))]


def _disk(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh]:
    """The disc with polar uvs: u is the radius, v the angle. Each triangle has its own corner in the middle."""
    disc = unit_disc()
    points = disc.vertices[disc.triangles]
    angle = (np.arange(len(points))[:, None] + (0.5, 0.0, 1.0)) / len(points)
    uvs = np.stack((np.linalg.norm(points, axis=2).clip(max=1.0), angle), axis=2)
    triangles = np.arange(3 * len(points), dtype=np.int32).reshape(-1, 3)
    return [Mesh(points.reshape(-1, 3), triangles, 0, uvs=uvs.reshape(-1, 1, 2).astype(np.float32))]


def _cube(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh]:
    with mitsuba(shape.place) as mi:
        return [_mesh(mi.load_dict({"type": "cube"}))]


def _obj(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh]:
    """The triangles of an `.obj` file, whose v points upwards unless the shape says otherwise."""
    meshes = [replace(mesh, material=0) for mesh in load_mesh_file(_path(shape, file, files), files).meshes]
    if shape.flag("flip_tex_coords", True):
        return meshes
    return [mesh if mesh.uvs is None else replace(mesh, uvs=mesh.uvs * (1, -1) + (0, 1)) for mesh in meshes]


def _by_mitsuba(shape: Plugin, file: Path, files: SceneFiles) -> list[Mesh]:
    """The triangles of a `.ply` file or of Mitsuba's own format, read by Mitsuba. trimesh leaves out the uvs of `.ply` files."""
    path = _path(shape, file, files)
    files.add_geometry(path.stat().st_size)
    values = {"type": shape.type, "filename": str(path)}
    values |= {"shape_index": int(shape.number("shape_index", 0))} if shape.type == "serialized" else {}
    with mitsuba(shape.place) as mi:
        try:
            mesh = mi.load_dict(values | {"flip_tex_coords": shape.flag("flip_tex_coords")})
        except (RuntimeError, ValueError) as error:
            raise BokehguideError(f"{path}: not a readable model ({reason(error)})") from None
        return [_mesh(mesh)]


def _mesh(mesh: Any) -> Mesh:
    """A mesh of Mitsuba."""
    vertices = np.array(mesh.vertex_positions_buffer(), np.float32).reshape(-1, 3)
    triangles = np.array(mesh.faces_buffer(), np.int64).reshape(-1, 3)
    normals = np.array(mesh.vertex_normals_buffer(), np.float32).reshape(-1, 3) if mesh.has_vertex_normals() else None
    uvs = np.array(mesh.vertex_texcoords_buffer(), np.float32).reshape(-1, 1, 2) if mesh.has_vertex_texcoords() else None
    normals = None if normals is None else unit_normals(normals, vertices, triangles)
    return Mesh(vertices, np.minimum(triangles, MAX_INT).astype(np.int32), 0, normals, uvs)


def _path(shape: Plugin, file: Path, files: SceneFiles) -> Path:
    """The path of a shape's file. Raises BokehguideError for a missing one, and for one outside the folder."""
    path = files.find(file.parent, shape.text("filename"), f"{shape.place}.filename")
    require_file(path, "model", f"{shape.place}.filename")
    return path


Reader = Callable[[Plugin, Path, SceneFiles], list[Mesh]]
READERS: dict[str, Reader] = {
    "sphere": _sphere,
    "cube": _cube,
    "rectangle": _rectangle,
    "disk": _disk,
    "obj": _obj,
    "ply": _by_mitsuba,
    "serialized": _by_mitsuba,
}
"""Readers of shapes by the name of the plugin, before their transform."""
