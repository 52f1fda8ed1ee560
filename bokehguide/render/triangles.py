"""Attributes of all triangles of a scene, as component arrays `[rows, T]` on the host.

Attributes that vary over a triangle are stored as the value at the first corner and the differences Δ1 and Δ2 to the other
corners. The value at a hit with the barycentric coordinates u and v is value + u Δ1 + v Δ2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bokehguide.scene.types import Mesh, Texture

SHORTEST = 1e-37
"""Least divisor of a normalisation, so that a zero vector stays zero."""


def spans(meshes: Sequence[Mesh]) -> Iterator[tuple[Mesh, slice]]:
    """Each mesh, and the slice of its triangles among all triangles."""
    start = 0
    for mesh in meshes:
        yield mesh, slice(start, start + len(mesh.triangles))
        start += len(mesh.triangles)


def joined(meshes: Sequence[Mesh]) -> tuple[np.ndarray, np.ndarray]:
    """All vertices, float32 `[V, 3]`, and the vertex indices of all triangles, int32 `[T, 3]`."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    triangles = np.concatenate([mesh.triangles for mesh in meshes], dtype=np.int32)
    for (_, span), offset in zip(spans(meshes), offsets):
        triangles[span] += np.int32(offset)
    return np.concatenate([mesh.vertices for mesh in meshes], dtype=np.float32), triangles


def normal_rows(meshes: Sequence[Mesh]) -> np.ndarray:
    """Unit geometric normals, then shading normals to interpolate: `[12, T]`."""
    rows = np.zeros((12, sum(len(mesh.triangles) for mesh in meshes)), np.float32)
    for mesh, span in spans(meshes):
        _, first, second = _differences(mesh.vertices, mesh.triangles)
        normal = _cross(first, second)
        lengths = np.sqrt(np.einsum("ij,ij->j", normal, normal))
        rows[0:3, span] = normal / np.maximum(lengths, SHORTEST)
        if mesh.normals is None:
            rows[3:6, span] = rows[0:3, span]
        else:
            rows[3:12, span] = np.concatenate(_differences(mesh.normals, mesh.triangles))
    return rows


def uv_rows(meshes: Sequence[Mesh], uv_sets: tuple[int, ...]) -> np.ndarray:
    """Texture coordinates `[6, sets, T]` of some UV sets; 0 where a mesh lacks one."""
    rows = np.zeros((6, len(uv_sets), sum(len(mesh.triangles) for mesh in meshes)), np.float32)
    for mesh, span in spans(meshes):
        for place, uv_set in enumerate(uv_sets):
            if mesh.uvs is not None and uv_set < mesh.uvs.shape[1]:
                rows[:, place, span] = np.concatenate(_differences(mesh.uvs[:, uv_set], mesh.triangles))
    return rows


def color_rows(meshes: Sequence[Mesh]) -> np.ndarray:
    """Vertex colours `[12, T]`, white and opaque where a mesh has none."""
    rows = np.zeros((12, sum(len(mesh.triangles) for mesh in meshes)), np.float32)
    rows[0:4] = 1.0
    for mesh, span in spans(meshes):
        if mesh.colors is not None:
            rows[:, span] = np.concatenate(_differences(mesh.colors, mesh.triangles))
    return rows


def tangent_rows(meshes: Sequence[Mesh], maps: list[Texture | None], smooth: bool = False) -> np.ndarray:
    """Tangents to interpolate and the sign of the bitangent for the `maps` of the materials: `[10, T]`.

    A tangent is 0 without a map, or where its u is constant. smooth: tangents derived from the uvs are means at the vertices of a
    mesh with normals, as in MikkTSpace; else each triangle has its own.
    """
    rows = np.zeros((10, sum(len(mesh.triangles) for mesh in meshes)), np.float32)
    for mesh, span in spans(meshes):
        texture = maps[mesh.material]
        if texture is None:
            continue
        if mesh.tangents is not None:
            rows[0:9, span] = np.concatenate(_differences(mesh.tangents[:, :3], mesh.triangles))
            rows[9, span] = mesh.tangents[mesh.triangles[:, 0], 3]
        elif mesh.uvs is not None and texture.uv_set < mesh.uvs.shape[1]:
            tangents, rows[9, span] = _tangents_from_uvs(mesh, texture.uv_set, texture.transform)
            if smooth and mesh.normals is not None:
                rows[0:9, span] = np.concatenate(_differences(_vertex_means(mesh, tangents), mesh.triangles))
            else:
                rows[0:3, span] = tangents
    return rows


def _tangents_from_uvs(mesh: Mesh, uv_set: int, transform: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Direction `[3, T]` of increasing u, and sign `[T]` of the bitangent, which points to the top of the texture."""
    _, first, second = _differences(mesh.vertices, mesh.triangles)
    assert mesh.uvs is not None
    _, du, dv = _differences(mesh.uvs[:, uv_set], mesh.triangles)
    linear = np.array(transform, np.float32).reshape(2, 3)[:, :2]
    (u1, v1), (u2, v2) = linear @ du, linear @ dv
    sign = np.sign(u1 * v2 - u2 * v1)
    tangent = sign * (v2 * first - v1 * second)
    tangent /= np.maximum(np.sqrt(np.einsum("ij,ij->j", tangent, tangent)), SHORTEST)
    # dP/dv points to the bottom of the texture: sign (u1 second - u2 first).
    up = sign * (u2 * first - u1 * second)
    side = np.einsum("ij,ij->j", _cross(_cross(first, second), tangent), up)
    return tangent, np.sign(side)


def _vertex_means(mesh: Mesh, values: np.ndarray) -> np.ndarray:
    """Means at vertices `[V, 3]` of values `[3, T]` of triangles, weighted by area."""
    _, first, second = _differences(mesh.vertices, mesh.triangles)
    area = np.sqrt((_cross(first, second) ** 2).sum(0))
    sums = np.zeros((len(mesh.vertices), 3))
    for corner in range(3):
        np.add.at(sums, mesh.triangles[:, corner], (values * area).T)
    return sums / np.maximum(np.sqrt((sums**2).sum(1)), SHORTEST)[:, None]


def _differences(values: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Component arrays `[C, T]` of vertex values `[V, C]`: those of the first corners, and the differences of the other two."""
    values = np.ascontiguousarray(values.T, np.float32)
    first = values[:, triangles[:, 0]]
    return first, values[:, triangles[:, 1]] - first, values[:, triangles[:, 2]] - first


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of `[3, T]` vectors."""
    return np.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))
