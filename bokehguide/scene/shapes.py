"""The three shapes of a scene file, and how a mesh is moved into world space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from bokehguide.scene.types import Mesh

# 1,280 triangles are the coarsest icosphere whose projected area (0.06 %) and
# silhouette (0.24 %) are right within 0.1 % and 0.3 %.
SPHERE_SUBDIVISIONS = 3


@lru_cache
def unit_sphere() -> Mesh:
    """A sphere of radius 1 with exact normals: 1,280 triangles, u around y, v downwards.

    Its vertices lie 0.24 % outside the true sphere, so that the surface area is 4π:
    by Cauchy's formula its projected area, averaged over all directions, is then π.
    """
    from trimesh.creation import icosphere  # trimesh takes a second to import, which nothing waits for that only reads options

    ico = icosphere(subdivisions=SPHERE_SUBDIVISIONS)
    points, triangles, uvs = _with_sphere_uvs(np.asarray(ico.vertices), np.asarray(ico.faces))
    scale = np.sqrt(4.0 * np.pi / ico.area)
    return Mesh(
        vertices=(points * scale).astype(np.float32),
        triangles=triangles.astype(np.int32),
        material=0,
        normals=points.astype(np.float32),
        uvs=uvs.astype(np.float32)[:, None],
    )


def _with_sphere_uvs(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, ...]:
    """Unwrap a unit sphere; triangles across the seam get vertices of their own, with u > 1."""
    u = 0.5 + np.arctan2(points[:, 0], points[:, 2]) / (2.0 * np.pi)
    v = np.arccos(np.clip(points[:, 1], -1.0, 1.0)) / np.pi
    uvs = np.stack([u, v], axis=1)
    corner_u = u[triangles]
    seam = np.ptp(corner_u, axis=1) > 0.5
    own = triangles[seam].ravel()
    own_uvs = uvs[own]
    own_uvs[:, 0] += own_uvs[:, 0] < 0.5
    triangles = triangles.copy()
    triangles[seam] = len(points) + np.arange(len(own)).reshape(-1, 3)
    return np.concatenate([points, points[own]]), triangles, np.concatenate([uvs, own_uvs])


@lru_cache
def unit_rectangle() -> Mesh:
    """A rectangle of 2 × 2 in the xy plane that faces +z."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)[:, None]
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), material=0, uvs=uvs)


@lru_cache
def unit_box() -> Mesh:
    """A box of side 1 around the origin; each face carries the whole texture."""
    face = unit_rectangle()
    turns = [(0, 0, 0), (0, 90, 0), (0, 180, 0), (0, 270, 0), (-90, 0, 0), (90, 0, 0)]
    sides = []
    for turn in turns:
        rotation = transform(rotate=turn)
        offset = transform(translate=(0, 0, 0.5), scale=0.5)
        sides.append(transformed(face, rotation @ offset))
    return joined(sides)


SHAPES = {"sphere": unit_sphere, "box": unit_box, "rectangle": unit_rectangle}


def transform(
    translate: Sequence[float] = (0.0, 0.0, 0.0),
    rotate: Sequence[float] = (0.0, 0.0, 0.0),
    scale: float | Sequence[float] = 1.0,
) -> np.ndarray:
    """The `[4, 4]` matrix that scales, turns about x, then y, then z (degrees), then moves."""
    from trimesh.transformations import euler_matrix

    angles = np.radians(np.asarray(rotate, dtype=np.float64))
    matrix = euler_matrix(*angles, axes="sxyz")
    matrix[:3, :3] *= np.broadcast_to(np.asarray(scale, dtype=np.float64), 3)
    matrix[:3, 3] = translate
    return matrix


def transformed(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """`mesh` under the affine `matrix` `[4, 4]`.

    Normals go by the inverse transpose, and a mirroring matrix turns the triangles'
    order and the bitangents' signs round, so that the front stays the front. A singular
    matrix (a scale of 0) leaves flat shading, as the normals are lost. What becomes too
    large for single precision becomes infinite.
    """
    linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = (mesh.vertices @ linear.T + matrix[:3, 3]).astype(np.float32)
        determinant = np.linalg.det(linear)
    triangles = mesh.triangles[:, ::-1] if determinant < 0.0 else mesh.triangles
    normals, tangents = (None, None) if determinant == 0.0 else (mesh.normals, mesh.tangents)
    if normals is not None:
        normals = _unit(normals @ np.linalg.inv(linear))
    if tangents is not None:
        signs = np.sign(determinant).astype(np.float32) * tangents[:, 3:]
        tangents = np.concatenate([_unit(tangents[:, :3] @ linear.T), signs], axis=1)
    return replace(
        mesh,
        vertices=np.ascontiguousarray(vertices),
        triangles=np.ascontiguousarray(triangles, dtype=np.int32),
        normals=normals,
        tangents=tangents,
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    """`[V, 3]` at length one, float32; zero vectors stay zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(lengths > 0.0, lengths, 1.0)).astype(np.float32)


def unit_normals(normals: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Normals `[V, 3]` at length one; one of length 0 becomes that of the faces around it, by area.

    Where there are no such faces it stays 0, which shades flat. Indices that are out of range count as no faces.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        unit = _unit(normals)
        lost = ~unit.any(axis=1)
        if not lost.any() or triangles.min(initial=0) < 0 or triangles.max(initial=0) >= len(vertices):
            return unit
        around = triangles[lost[triangles].any(axis=1)]
        a, b, c = np.moveaxis(vertices.astype(np.float64)[around], 1, 0)
        faces, total = np.cross(b - a, c - a), np.zeros((len(vertices), 3))
        for corner in around.T:
            np.add.at(total, corner, np.nan_to_num(faces))
        unit[lost] = _unit(total[lost])
    return unit


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Meshes of one material as one; normals, uvs, tangents and colours stay where all of them have them."""
    counts = [len(mesh.vertices) for mesh in meshes]
    offsets = np.concatenate([[0], np.cumsum(counts)[:-1]])
    optional = {
        name: np.concatenate([getattr(mesh, name) for mesh in meshes])
        if all(getattr(mesh, name) is not None for mesh in meshes)
        else None
        for name in ("normals", "uvs", "tangents", "colors")
    }
    return replace(
        meshes[0],
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        triangles=np.concatenate(
            [mesh.triangles + offset for mesh, offset in zip(meshes, offsets)]
        ).astype(np.int32),
        **optional,
    )


def spheres(centres: np.ndarray, radii: np.ndarray | float, material: int) -> Mesh:
    """Many spheres as one mesh: `centres` `[N, 3]` and `radii` `[N]` or a number, metres."""
    unit = unit_sphere()
    centres = np.asarray(centres, dtype=np.float64)
    count, size = len(centres), len(unit.vertices)
    radii = np.broadcast_to(radii, count)[:, None, None]
    vertices = centres[:, None] + radii * unit.vertices
    triangles = unit.triangles + size * np.arange(count, dtype=np.int32)[:, None, None]
    return Mesh(
        vertices=vertices.reshape(-1, 3).astype(np.float32),
        triangles=triangles.reshape(-1, 3),
        material=material,
        normals=np.tile(unit.normals, (count, 1)),
    )
