"""The focus distance of a pixel or of a named object."""

from __future__ import annotations

import difflib
from dataclasses import replace

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.cameras import Focus
from bokehguide.scene.sight import Sight, frame_rays, to_raster
from bokehguide.scene.tables import IN_FRONT, shown
from bokehguide.scene.types import Camera, FilmSettings, Mesh, Scene

GRID = 96
"""Rays along each side of the box around an object in the frame."""
MAX_TARGETS = 4096
"""Triangles of an object that rays aim at where the grid misses a thin object."""


def focused(scene: Scene, focus: Focus) -> Scene:
    """`scene` with a focus distance, metres along the optical axis, as `focus` asks for.

    Raises BokehguideError, naming the key or option, for a point outside the frame or where nothing is visible, for an
    unknown name, and for an object that is not visible from the centre of the lens.
    """
    depth = _depth_at(scene, focus) if focus.at is not None else _depth_of(scene, focus)
    if not IN_FRONT.contains(depth):
        raise BokehguideError(f"{focus.place}: is {depth:g} m from the lens; move the camera back")
    return replace(scene, camera=replace(scene.camera, focus_distance=depth))


def raster_position(focus: Focus, film: FilmSettings) -> tuple[float, float]:
    """The raster position of `focus.at`: a fraction of the frame, or the middle of a pixel."""
    assert focus.at is not None
    x, y = focus.at
    if max(x, y) <= 1.0:
        return x * film.width, y * film.height
    if x >= film.width or y >= film.height:
        raise BokehguideError(
            f"{focus.place}: {x:g},{y:g} lies outside the frame of {film.width}x{film.height} pixels; "
            "give a pixel of it, or fractions of it, at most 1"
        )
    return np.floor(x) + 0.5, np.floor(y) + 0.5


def _depth_at(scene: Scene, focus: Focus) -> float:
    """The depth of the first visible surface at a point of the frame."""
    rays = frame_rays(scene.camera, scene.film, np.array([raster_position(focus, scene.film)]))
    depth = float(Sight(scene.meshes, scene.materials).along(np.array(scene.camera.position), rays).distance[0])
    if not np.isfinite(depth):
        assert focus.at is not None
        x, y = focus.at
        raise BokehguideError(
            f"{focus.place}: nothing but background at {x:g},{y:g}; give a point on a surface, or the focus distance inf"
        )
    return depth


def _depth_of(scene: Scene, focus: Focus) -> float:
    """The median depth of the visible part of a named object."""
    chosen = named_meshes(scene, focus)
    camera, origin = scene.camera, np.array(scene.camera.position)
    sight = Sight(scene.meshes, scene.materials)
    corners = [_corners(scene.meshes[number]) for number in chosen]
    grid = _box_grid(np.concatenate(corners).reshape(-1, 3), camera, scene.film)
    for rays in (frame_rays(camera, scene.film, grid), _aimed_rays(np.concatenate(corners), camera, scene.film)):
        seen = sight.along(origin, rays)
        visible = np.isin(seen.mesh, chosen)
        if visible.any():
            return float(np.median(seen.distance[visible]))
    raise BokehguideError(f"{focus.place}: {shown(focus.on)} is not visible in the frame; turn the camera, or give a distance")


def named_meshes(scene: Scene, focus: Focus) -> list[int]:
    """Indices of the meshes whose object, glTF node or material has the name `focus.on`."""
    names = [_names(scene, mesh) for mesh in scene.meshes]
    chosen = [number for number, known in enumerate(names) if focus.on in known]
    if not chosen:
        known = list(dict.fromkeys(name for some in names for name in some))
        near = difflib.get_close_matches(focus.on, known, n=3) or known
        hint = "did you mean" if len(near) < len(known) else "known are"
        listed = printable(", ".join(map(shown, near)), 300)
        raise BokehguideError(f"{focus.place}: {shown(focus.on)} is no object, node or material of the scene; {hint} {listed}")
    return chosen


def _names(scene: Scene, mesh: Mesh) -> tuple[str, ...]:
    """All names under which a mesh may be called."""
    names = (mesh.name, *mesh.groups, scene.materials[mesh.material].name)
    return tuple(name for name in names if name)


def _corners(mesh: Mesh) -> np.ndarray:
    """Corners of the triangles of a mesh, float64 `[T, 3, 3]`."""
    return mesh.vertices[mesh.triangles].astype(np.float64)


def _box_grid(points: np.ndarray, camera: Camera, film: FilmSettings) -> np.ndarray:
    """Raster positions `[GRID², 2]` over the part of the frame that `points` `[N, 3]` may cover."""
    size = np.array([film.width, film.height], dtype=np.float64)
    raster, depth = to_raster(camera, film, points)
    low, high = np.zeros(2), size
    if (depth > 0.0).all():
        low, high = (np.clip(edge, 0.0, size) for edge in (raster.min(axis=0), raster.max(axis=0)))
    steps = (np.arange(GRID) + 0.5) / GRID
    x, y = (low[axis] + (high[axis] - low[axis]) * steps for axis in (0, 1))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _aimed_rays(corners: np.ndarray, camera: Camera, film: FilmSettings) -> np.ndarray:
    """Rays of depth 1 `[N, 3]` to the middles of triangles `[T, 3, 3]` in the frame."""
    middles = corners[:: len(corners) // MAX_TARGETS + 1].mean(axis=1)
    raster, depth = to_raster(camera, film, middles)
    inside = (depth > 0.0) & (raster >= 0.0).all(axis=1) & (raster <= (film.width, film.height)).all(axis=1)
    return frame_rays(camera, film, raster[inside])
