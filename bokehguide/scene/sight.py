"""Lines of sight: the first visible surfaces along rays, and the rays of a frame.

The renderer has its own tracer, which needs the whole scene as tensors. This module serves questions before a render: what a
pixel shows, and which part of an object is visible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bokehguide.scene.types import Camera, FilmSettings, Material, Mesh, Texture
from bokehguide.stopping import default_signals

MAX_CROSSINGS = 32
"""Invisible surfaces that a line of sight crosses at most."""
STEP = 1e-5
"""Offset beyond an invisible surface, relative to the distance and to the coordinates of the ray's origin."""
VISIBLE = 0.5
"""Smallest opacity of a visible surface of the alpha mode `blend`."""


@dataclass(frozen=True)
class Seen:
    """First visible surfaces along N rays. distance: in lengths of the direction, inf without one, float64 `[N]`.
    mesh: index, -1 without one, `[N]`."""

    distance: np.ndarray
    mesh: np.ndarray


class Sight:
    """Finds the first visible surfaces of `meshes` along rays.

    A surface is visible where its opacity is at least `alpha_cutoff` (alpha mode `mask`) or VISIBLE (`blend`). Glass is
    visible.
    """

    def __init__(self, meshes: Sequence[Mesh], materials: Sequence[Material]):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._meshes, self._materials = meshes, materials
        counts = [len(mesh.triangles) for mesh in meshes]
        self._first = np.concatenate([[0], np.cumsum(counts)])
        """Number of the first triangle of each mesh."""
        offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        triangles = np.concatenate([mesh.triangles + np.int32(offset) for mesh, offset in zip(meshes, offsets)], dtype=np.int32)
        vertices = np.concatenate([mesh.vertices for mesh in meshes], dtype=np.float32)
        with default_signals():  # embreex holds the interpreter's lock
            self._scene = EmbreeScene(robust=True)
            self._embree_mesh = TriangleMesh(self._scene, vertices, triangles)

    def along(self, origin: np.ndarray, directions: np.ndarray) -> Seen:
        """The first visible surfaces from `origin` `[3]` in `directions` `[N, 3]`, which need no unit length."""
        count = len(directions)
        directions = np.ascontiguousarray(directions, np.float32)
        distance, mesh = np.full(count, np.inf), np.full(count, -1)
        waiting, start = np.arange(count), np.zeros(count)
        for _ in range(MAX_CROSSINGS):
            if len(waiting) == 0:
                break
            rays = directions[waiting]
            origins = (origin + start[waiting, None] * rays).astype(np.float32)
            found = self._scene.run(origins, rays, output=True)
            met = found["primID"] >= 0
            waiting, triangle = waiting[met], found["primID"][met]
            reached = start[waiting] + found["tfar"][met].astype(np.float64)
            which = np.searchsorted(self._first, triangle, side="right") - 1
            visible = self._visible(which, triangle, found["u"][met], found["v"][met])
            distance[waiting[visible]], mesh[waiting[visible]] = reached[visible], which[visible]
            scale = np.abs(origin).max() / np.linalg.norm(directions[waiting], axis=1)
            start[waiting] = reached + STEP * (reached + scale)
            waiting = waiting[~visible]
        return Seen(distance, mesh)

    def _visible(self, which: np.ndarray, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Whether hits are visible, bool `[N]`. which: the mesh of each hit; u, v: weights of vertices 1 and 2."""
        visible = np.ones(len(which), bool)
        for number in np.unique(which):
            mesh, hits = self._meshes[number], np.flatnonzero(which == number)
            material = self._materials[mesh.material]
            if material.alpha_mode != "opaque":
                corners = mesh.triangles[triangle[hits] - self._first[number]]
                weights = np.stack([1.0 - u[hits] - v[hits], u[hits], v[hits]], axis=1)
                least = material.alpha_cutoff if material.alpha_mode == "mask" else VISIBLE
                visible[hits] = _opacity(mesh, material, corners, weights) >= least
        return visible


def _opacity(mesh: Mesh, material: Material, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Opacity `[N]` at points with `weights` `[N, 3]` of the vertices `corners` `[N, 3]`, of the nearest texel."""
    opacity = np.full(len(corners), material.opacity)
    if mesh.colors is not None:
        opacity *= (mesh.colors[corners, 3] * weights).sum(1)
    texture = material.base_color_texture
    if texture is not None and texture.image.shape[2] == 4:
        uv = np.zeros((len(corners), 2))
        if mesh.uvs is not None and texture.uv_set < mesh.uvs.shape[1]:
            uv = np.einsum("nc,ncd->nd", weights, mesh.uvs[corners, texture.uv_set])
        opacity *= _texels(texture, uv)[:, 3]
    return opacity


def _texels(texture: Texture, uv: np.ndarray) -> np.ndarray:
    """The nearest texels `[N, C]` of a texture at `uv` `[N, 2]`."""
    a, b, c, d, e, f = texture.transform
    moved = (a * uv[:, 0] + b * uv[:, 1] + c, d * uv[:, 0] + e * uv[:, 1] + f)
    height, width = texture.image.shape[:2]
    column, row = (_index(place, size, wrap) for place, size, wrap in zip(moved, (width, height), texture.wrap))
    return texture.image[row, column]


def _index(place: np.ndarray, size: int, wrap: str) -> np.ndarray:
    """Texel numbers `[N]` along one side of `size` texels."""
    if wrap == "repeat":
        place = place - np.floor(place)
    elif wrap == "mirror":
        place = 1.0 - np.abs(place - 2.0 * np.floor(place / 2.0) - 1.0)
    return np.clip(np.floor(place * size), 0, size - 1).astype(np.int64)


def camera_axes(camera: Camera) -> np.ndarray:
    """Unit vectors to the right, up and forward of a camera, as rows `[3, 3]`."""
    forward = np.subtract(camera.target, camera.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def pixel_slope(camera: Camera, film: FilmSettings) -> float:
    """Width of a pixel at unit distance."""
    return 2.0 * np.tan(np.radians(camera.fov) / 2.0) / film.width


def frame_rays(camera: Camera, film: FilmSettings, raster: np.ndarray) -> np.ndarray:
    """Directions `[N, 3]` of depth 1 from the lens centre through raster positions `[N, 2]`, in pixels from the top left."""
    slope = pixel_slope(camera, film)
    x = (raster[:, 0] - 0.5 * film.width) * slope
    y = (0.5 * film.height - raster[:, 1]) * slope
    return np.stack([x, y, np.ones_like(x)], axis=1) @ camera_axes(camera)


def frame_grid(film: FilmSettings, columns: int, rows: int) -> np.ndarray:
    """Raster positions `[columns · rows, 2]` of the middles of a grid over the frame."""
    x = (np.arange(columns) + 0.5) * film.width / columns
    y = (np.arange(rows) + 0.5) * film.height / rows
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def to_raster(camera: Camera, film: FilmSettings, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Raster positions `[N, 2]` and depths `[N]` of world points `[N, 3]`; positions behind the camera are NaN."""
    x, y, depth = camera_axes(camera) @ (points - np.asarray(camera.position)).T
    scale = 1.0 / (np.where(depth > 0.0, depth, np.nan) * pixel_slope(camera, film))
    return np.stack([0.5 * film.width + x * scale, 0.5 * film.height - y * scale], axis=1), depth


def coc_diameter(camera: Camera, film: FilmSettings, depth: np.ndarray | float) -> np.ndarray:
    """Diameter in pixels of the circle of confusion at `depth`, metres along the axis; inf is allowed (Eq. 23)."""
    with np.errstate(divide="ignore"):
        gap = np.abs(1.0 / camera.focus_distance - 1.0 / np.asarray(depth, dtype=np.float64))
    return 2.0 * camera.aperture_radius * gap / pixel_slope(camera, film)
