"""What is known about each triangle of a scene, as component arrays `[rows, T]` on the host.

Values that vary over a triangle are kept as the first corner's and its differences to the
other two: value + u Δ1 + v Δ2 at a hit's u and v.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bokehguide.scene.types import Mesh, Texture


def spans(meshes: tuple[Mesh, ...]) -> Iterator[tuple[Mesh, slice]]:
    """Each mesh and where its triangles lie among those of all."""
    start = 0
    for mesh in meshes:
        yield mesh, slice(start, start + len(mesh.triangles))
        start += len(mesh.triangles)


def joined(meshes: tuple[Mesh, ...]) -> tuple[np.ndarray, np.ndarray]:
    """All vertices, float32 `[V, 3]`, and the triangles' indices into them, int32 `[T, 3]`."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    triangles = np.concatenate([mesh.triangles for mesh in meshes], dtype=np.int32)
    for (_, span), offset in zip(spans(meshes), offsets):
        triangles[span] += np.int32(offset)
    return np.concatenate([mesh.vertices for mesh in meshes], dtype=np.float32), triangles


def normal_rows(meshes: tuple[Mesh, ...]) -> np.ndarray:
    """Unit geometric normals, then shading normals to interpolate: `[12, T]`."""
    rows = np.zeros((12, sum(len(mesh.triangles) for mesh in meshes)), np.float32)
    for mesh, span in spans(meshes):
        _, first, second = _differences(mesh.vertices, mesh.triangles)
        normal = _cross(first, second)
        lengths = np.sqrt(np.einsum("ij,ij->j", normal, normal))
        rows[0:3, span] = normal / np.maximum(lengths, 1e-37)
        if mesh.normals is None:
            rows[3:6, span] = rows[0:3, span]
        else:
            rows[3:12, span] = np.concatenate(_differences(mesh.normals, mesh.triangles))
    return rows


def uv_rows(meshes: tuple[Mesh, ...], uv_sets: tuple[int, ...]) -> np.ndarray:
    """Texture coordinates `[6, sets, T]` of some of the meshes' sets; 0 where a mesh lacks one."""
    rows = np.zeros((6, len(uv_sets), sum(len(mesh.triangles) for mesh in meshes)), np.float32)
    for mesh, span in spans(meshes):
        for place, uv_set in enumerate(uv_sets):
            if mesh.uvs is not None and uv_set < mesh.uvs.shape[1]:
                rows[:, place, span] = np.concatenate(_differences(mesh.uvs[:, uv_set], mesh.triangles))
    return rows


def color_rows(meshes: tuple[Mesh, ...]) -> np.ndarray:
    """Vertex colours `[12, T]`, white and opaque where a mesh has none."""
    rows = np.zeros((12, sum(len(mesh.triangles) for mesh in meshes)), np.float32)
    rows[0:4] = 1.0
    for mesh, span in spans(meshes):
        if mesh.colors is not None:
            rows[:, span] = np.concatenate(_differences(mesh.colors, mesh.triangles))
    return rows


def tangent_rows(meshes: tuple[Mesh, ...], normal_maps: list[Texture | None]) -> np.ndarray:
    """Tangents to interpolate and the bitangent's sign for the materials' `normal_maps`: `[10, T]`.

    A tangent is 0 where there is no normal map, or no direction in which its u grows.
    """
    rows = np.zeros((10, sum(len(mesh.triangles) for mesh in meshes)), np.float32)
    for mesh, span in spans(meshes):
        texture = normal_maps[mesh.material]
        if texture is None:
            continue
        if mesh.tangents is not None:
            rows[0:9, span] = np.concatenate(_differences(mesh.tangents[:, :3], mesh.triangles))
            rows[9, span] = mesh.tangents[mesh.triangles[:, 0], 3]
        elif mesh.uvs is not None and texture.uv_set < mesh.uvs.shape[1]:
            rows[0:3, span], rows[9, span] = _tangents_from_uvs(mesh, texture.uv_set, texture.transform)
    return rows


def _tangents_from_uvs(mesh: Mesh, uv_set: int, transform: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The direction `[3, T]` in which the texture's u grows, and the sign of the bitangent, its top, `[T]`."""
    _, first, second = _differences(mesh.vertices, mesh.triangles)
    _, du, dv = _differences(mesh.uvs[:, uv_set], mesh.triangles)
    linear = np.array(transform, np.float32).reshape(2, 3)[:, :2]
    (u1, v1), (u2, v2) = linear @ du, linear @ dv
    sign = np.sign(u1 * v2 - u2 * v1)
    tangent = sign * (v2 * first - v1 * second)
    tangent /= np.maximum(np.sqrt(np.einsum("ij,ij->j", tangent, tangent)), 1e-37)
    # dP/dv, which points to the texture's bottom, is sign (u1 second - u2 first).
    up = sign * (u2 * first - u1 * second)
    side = np.einsum("ij,ij->j", _cross(_cross(first, second), tangent), up)
    return tangent, np.sign(side)


def _differences(values: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Component arrays `[C, T]` of vertex values `[V, C]`: first corners, and the other two less these."""
    values = np.ascontiguousarray(values.T, np.float32)
    first = values[:, triangles[:, 0]]
    return first, values[:, triangles[:, 1]] - first, values[:, triangles[:, 2]] - first


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of `[3, T]` vectors."""
    return np.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))
