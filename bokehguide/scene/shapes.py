"""Built-in shapes, and affine transforms of meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from bokehguide.scene.icosphere import icosphere
from bokehguide.scene.types import Mesh

SPHERE_SUBDIVISIONS = 3
"""1,280 triangles: the error of the projected area is 0.06 %, that of the silhouette 0.24 %."""
MOST_SPHERES = (3000, 12000)
"""Spheres of a scene up to which each has 1,280 and 320 triangles; beyond, 80. Many spheres of a picture are small."""
SIDES = 64
"""Flat sides of cylinders, cones and capsules."""
FEW_INSTANCES = 64
"""Instances below which each is transformed by itself."""


def sphere_subdivisions(count: int) -> int:
    """Subdivisions of each of `count` spheres of a scene."""
    return SPHERE_SUBDIVISIONS - sum(count > most for most in MOST_SPHERES)


@lru_cache
def unit_sphere(subdivisions: int = SPHERE_SUBDIVISIONS) -> Mesh:
    """A sphere of radius 1 with exact normals: 20 · 4^subdivisions triangles, u around y, v downwards.

    Its surface area is 4π, so that its mean projected area is π (Cauchy). With 1,280 triangles, its vertices
    therefore lie 0.24 % outside the sphere. Each subdivision less makes a quarter of the triangles and four times the error.
    """
    points, triangles = icosphere(subdivisions)
    a, b, c = points[triangles].transpose(1, 0, 2)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    points, triangles, uvs = _with_sphere_uvs(points, triangles)
    scale = np.sqrt(4.0 * np.pi / area)
    return Mesh(
        vertices=(points * scale).astype(np.float32),
        triangles=triangles.astype(np.int32),
        material=0,
        normals=points.astype(np.float32),
        uvs=uvs.astype(np.float32)[:, None],
    )


def _with_sphere_uvs(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, ...]:
    """Points, triangles and uvs of a unit sphere. Triangles across the seam get their own vertices, with u > 1."""
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
    """A square of side 2 in the xy plane that faces +z."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)[:, None]
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), material=0, uvs=uvs)


DISC_CORNERS = 64
"""The silhouette of a disc is within 0.12 % of the circle."""


@lru_cache
def unit_disc() -> Mesh:
    """A disc of radius 1 in the xy plane that faces +z. Its area is π, so that its corners lie 0.08 % outside the circle."""
    angles = 2.0 * np.pi * np.arange(DISC_CORNERS) / DISC_CORNERS
    radius = np.sqrt(2.0 * np.pi / (DISC_CORNERS * np.sin(2.0 * np.pi / DISC_CORNERS)))
    rim = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(DISC_CORNERS)], axis=1)
    points = np.concatenate([np.zeros((1, 3)), rim])
    corners = 1 + np.arange(DISC_CORNERS)
    triangles = np.stack([np.zeros_like(corners), corners, np.roll(corners, -1)], axis=1)
    uvs = np.stack([0.5 + 0.5 * points[:, 0], 0.5 - 0.5 * points[:, 1]], axis=1)
    return Mesh(points.astype(np.float32), triangles.astype(np.int32), material=0, uvs=uvs.astype(np.float32)[:, None])


def tube(radius: float, height: float, top: float) -> Mesh:
    """The side of a cylinder or cone around z, in the middle of its height, with smooth normals. top: the radius at +z."""
    angles = 2.0 * np.pi * np.arange(SIDES + 1) / SIDES
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(SIDES + 1)], axis=1)
    low, high = ring * radius - (0, 0, height / 2.0), ring * top + (0, 0, height / 2.0)
    normals = ring * height + (0, 0, radius - top)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    u = np.arange(SIDES + 1) / SIDES
    uvs = np.concatenate([np.stack([u, np.full_like(u, v)], axis=1) for v in (1.0, 0.0)])
    return Mesh(np.concatenate([low, high]), strip(2, SIDES + 1), 0, np.tile(normals, (2, 1)), uvs[:, None])


def strip(rows: int, columns: int) -> np.ndarray:
    """Triangles of a grid of vertices that turn anticlockwise around the row above."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, above = corner + 1, corner + columns
    return np.concatenate([np.stack([corner, right, above + 1], 1), np.stack([corner, above + 1, above], 1)]).astype(np.int32)


@lru_cache
def unit_box() -> Mesh:
    """A cube of side 1 around the origin. Each face shows the whole texture."""
    face = unit_rectangle()
    turns = [(0, 0, 0), (0, 90, 0), (0, 180, 0), (0, 270, 0), (-90, 0, 0), (90, 0, 0)]
    sides = []
    for turn in turns:
        rotation = transform(rotate=turn)
        offset = transform(translate=(0, 0, 0.5), scale=0.5)
        sides.append(transformed(face, rotation @ offset))
    return joined(sides)


SHAPES = {"sphere": unit_sphere, "box": unit_box, "rectangle": unit_rectangle, "disc": unit_disc}


def transform(translate: ArrayLike = (0.0, 0.0, 0.0), rotate: ArrayLike = (0.0, 0.0, 0.0), scale: ArrayLike = 1.0) -> np.ndarray:
    """The matrix `[4, 4]` that scales, rotates about x, y and z in this order (degrees), and translates."""
    angles = np.radians(np.asarray(rotate, dtype=np.float64))
    (sx, sy, sz), (cx, cy, cz) = np.sin(angles), np.cos(angles)
    matrix = np.eye(4)
    matrix[0, :3] = cy * cz, sy * (sx * cz) - cx * sz, sy * (cx * cz) + sx * sz
    matrix[1, :3] = cy * sz, sy * (sx * sz) + cx * cz, sy * (cx * sz) - sx * cz
    matrix[2, :3] = -sy, cy * sx, cy * cx
    matrix[:3, :3] *= np.broadcast_to(np.asarray(scale, dtype=np.float64), 3)
    matrix[:3, 3] = translate
    return matrix


def transformed(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """`mesh` under the affine `matrix` `[4, 4]`.

    Normals transform with the inverse transpose. A reflection reverses the vertex order of the
    triangles and the signs of the bitangents, so that front faces stay front faces. A singular
    matrix gives flat shading. Values beyond single precision become infinite.
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
        signs = np.float32(np.sign(determinant)) * tangents[:, 3:]
        tangents = np.concatenate([_unit(tangents[:, :3] @ linear.T), signs], axis=1)
    return replace(
        mesh,
        vertices=np.ascontiguousarray(vertices),
        triangles=np.ascontiguousarray(triangles, dtype=np.int32),
        normals=normals,
        tangents=tangents,
    )


def instanced(mesh: Mesh, matrices: np.ndarray) -> Mesh:
    """The copies of `mesh` under affine `matrices` `[N, 4, 4]` as one mesh.

    The result is that of `joined` over `transformed`, which stays the way for few matrices.
    """
    determinants = np.linalg.det(matrices[:, :3, :3])
    if len(matrices) < FEW_INSTANCES or not (determinants > 0.0).all():
        return joined([transformed(mesh, matrix) for matrix in matrices])
    count, size = len(matrices), len(mesh.vertices)
    linear = matrices[:, :3, :3].transpose(0, 2, 1)
    optional: dict[str, np.ndarray | None] = {"normals": None, "tangents": None}
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = (mesh.vertices @ linear + matrices[:, None, :3, 3]).astype(np.float32).reshape(-1, 3)
        if mesh.normals is not None:
            optional["normals"] = _unit((mesh.normals @ np.linalg.inv(matrices[:, :3, :3])).reshape(-1, 3))
        if mesh.tangents is not None:
            axes = _unit((mesh.tangents[:, :3] @ linear).reshape(-1, 3))
            optional["tangents"] = np.concatenate([axes, np.tile(mesh.tangents[:, 3:], (count, 1))], axis=1)
    triangles = mesh.triangles + size * np.arange(count, dtype=np.int32)[:, None, None]
    return replace(
        mesh,
        vertices=vertices,
        triangles=triangles.reshape(-1, 3).astype(np.int32),
        uvs=None if mesh.uvs is None else np.tile(mesh.uvs, (count, 1, 1)),
        colors=None if mesh.colors is None else np.tile(mesh.colors, (count, 1)),
        **optional,
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors `[V, 3]`, float32. Zero vectors stay zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(lengths > 0.0, lengths, 1.0)).astype(np.float32)


def unit_normals(normals: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals `[V, 3]`. A zero normal becomes the area-weighted normal of its faces.

    It stays 0, which is flat shading, without such faces or if any index is out of range.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        unit = _unit(normals)
        zero = np.logical_not(unit.any(axis=1))
        if not zero.any() or triangles.min(initial=0) < 0 or triangles.max(initial=0) >= len(vertices):
            return unit
        around = triangles[zero[triangles].any(axis=1)]
        a, b, c = np.moveaxis(vertices.astype(np.float64)[around], 1, 0)
        faces, total = np.cross(b - a, c - a), np.zeros((len(vertices), 3))
        for corner in around.T:
            np.add.at(total, corner, np.nan_to_num(faces))
        unit[zero] = _unit(total[zero])
    return unit


def reversed_mesh(mesh: Mesh) -> Mesh:
    """The same triangles, facing the other side."""
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, triangles=np.ascontiguousarray(mesh.triangles[:, ::-1]), normals=normals)


def facing_normals(mesh: Mesh) -> Mesh:
    """The same triangles, facing the side of the normals of their vertices, if there are any."""
    if mesh.normals is None:
        return mesh
    triangles = mesh.triangles
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[triangles], 1, 0)
    away = (np.cross(b - a, c - a) * mesh.normals[triangles].sum(axis=1)).sum(axis=1) < 0.0
    return replace(mesh, triangles=np.where(away[:, None], triangles[:, ::-1], triangles))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Meshes as one mesh of the material of the first. Normals, uvs, tangents and colours stay if every mesh has them."""
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
        triangles=np.concatenate([mesh.triangles + offset for mesh, offset in zip(meshes, offsets)]).astype(np.int32),
        **optional,
    )


def spheres(centres: ArrayLike, radii: ArrayLike, material: int, subdivisions: int = SPHERE_SUBDIVISIONS) -> Mesh:
    """N spheres as one mesh. centres: `[N, 3]`, metres. radii: `[N]` or a number, metres."""
    unit = unit_sphere(subdivisions)
    assert unit.normals is not None
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


def repeated(mesh: Mesh, centres: np.ndarray, material: int, name: str = "") -> Mesh:
    """Copies of `mesh`, moved by each of `centres` `[N, 3]`, as one mesh without uvs."""
    count, size = len(centres), len(mesh.vertices)
    vertices = np.asarray(centres, dtype=np.float64)[:, None] + mesh.vertices
    triangles = mesh.triangles + size * np.arange(count, dtype=np.int32)[:, None, None]
    return Mesh(
        vertices=vertices.reshape(-1, 3).astype(np.float32),
        triangles=triangles.reshape(-1, 3),
        material=material,
        normals=None if mesh.normals is None else np.tile(mesh.normals, (count, 1)),
        name=name,
    )


def surface_area(mesh: Mesh) -> float:
    """The area of all triangles in square metres."""
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
