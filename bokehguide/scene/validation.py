"""Checks that every scene passes before it reaches the renderer.

Embree reads outside its arrays if an index is out of range, so no check is optional.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.limits import LARGEST, MAX_EXTENT, MAX_PIXELS, MAX_SUNS, MAX_TRIANGLES
from bokehguide.scene.types import Mesh, Scene


def checked(scene: Scene, place: str) -> Scene:
    """`scene` without triangles of zero area and without meshes that have no other triangles.

    Removed emitters cause a warning. place: the user's name of the scene, such as its file. Raises
    BokehguideError, naming `place`, for values that are not finite, indices out of range, no
    remaining triangle, and too many pixels.
    """
    film = scene.film
    if film.width * film.height > MAX_PIXELS:
        raise BokehguideError(f"{place}: film: {film.width}x{film.height} pixels are too many; give at most {MAX_PIXELS}")
    check_triangles(sum(len(mesh.triangles) for mesh in scene.meshes), place)
    if len(scene.suns) > MAX_SUNS:
        raise BokehguideError(f"{place}: has {len(scene.suns):,} suns; give at most {MAX_SUNS}")
    for number, mesh in enumerate(scene.meshes):
        check_mesh(mesh, f"{place}: mesh {number}", len(scene.materials))
    meshes = tuple(mesh for mesh in map(_without_degenerate, scene.meshes) if len(mesh.triangles))
    if not meshes:
        raise BokehguideError(f"{place}: holds no triangle with an area; add an object or a model with a surface")
    lost = _removed_emitters(scene, meshes)
    return replace(scene, meshes=meshes, warnings=tuple(dict.fromkeys((*scene.warnings, *lost))))


def _removed_emitters(scene: Scene, kept: tuple[Mesh, ...]) -> list[str]:
    """A warning for each emissive material that no mesh of `kept` uses."""
    used, left = {mesh.material for mesh in scene.meshes}, {mesh.material for mesh in kept}
    materials = [scene.materials[number] for number in sorted(used - left)]
    return [f"material {m.name}: emits, but from no triangle with an area" for m in materials if m.emits]


def check_mesh(mesh: Mesh, place: str, materials: int) -> None:
    """Raise BokehguideError, naming `place`, if `mesh` is not finite, too large or inconsistent.

    materials: number of materials in the scene.
    """
    count = len(mesh.vertices)
    sets = 0 if mesh.uvs is None else mesh.uvs.shape[1]
    shapes = {"vertices": (3,), "normals": (3,), "uvs": (sets, 2), "tangents": (4,), "colors": (4,)}
    for name, shape in shapes.items():
        values = getattr(mesh, name)
        if values is None:
            continue
        if values.shape != (count, *shape):
            raise BokehguideError(f"{place}: {name} has shape {values.shape}, not {(count, *shape)}; repair the model")
        bad = np.flatnonzero(~(np.abs(values) <= LARGEST).all(axis=tuple(range(1, values.ndim))))
        if len(bad):
            raise BokehguideError(
                f"{place}: {name}[{bad[0]}] is {values[bad[0]].tolist()}, not finite "
                f"or beyond {LARGEST:g}; repair the model ({len(bad)} such)"
            )
    extent = np.ptp(mesh.vertices, axis=0).max() if count else 0.0
    if extent > MAX_EXTENT:
        raise BokehguideError(f"{place}: is {extent:.3g} m from end to end; scale it to {MAX_EXTENT:g} m or less")
    out = np.flatnonzero(((mesh.triangles < 0) | (mesh.triangles >= count)).any(axis=1))
    if len(out):
        raise BokehguideError(
            f"{place}: triangle {out[0]} has the indices {mesh.triangles[out[0]].tolist()}, but "
            f"there are {count} vertices; repair the model ({len(out)} such)"
        )
    if not 0 <= mesh.material < materials:
        raise BokehguideError(f"{place}: material {mesh.material} of {materials} does not exist")


def check_triangles(count: int, place: str, most: int | None = None) -> None:
    """Raise BokehguideError, naming `place`, if the scene has more than `most` triangles up to `place`, None: MAX_TRIANGLES."""
    most = MAX_TRIANGLES if most is None else min(most, MAX_TRIANGLES)
    if count > most:
        few = "" if most == MAX_TRIANGLES else " for files as small as these"
        raise BokehguideError(f"{place}: makes {count:,} triangles in all; give a scene of at most {most:,}{few}")


def check_meshes(count: int, place: str, most: int) -> None:
    """Raise BokehguideError, naming `place`, if the scene has more than `most` meshes up to `place`."""
    if count > most:
        raise BokehguideError(f"{place}: makes {count:,} meshes in all; join them to {most:,} for files as small as these")


def _without_degenerate(mesh: Mesh) -> Mesh:
    """`mesh` without triangles of zero area."""
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    doubled_area = np.sqrt(_squares(np.cross(b - a, c - a)))
    longest = np.maximum(np.maximum(_squares(b - a), _squares(c - b)), _squares(a - c))
    # A smaller area gives a normal that is rounding noise, or whose square underflows, in single precision.
    kept = doubled_area > np.maximum(1e-7 * longest, 1e-18)
    return mesh if kept.all() else replace(mesh, triangles=mesh.triangles[kept])


def _squares(vectors: np.ndarray) -> np.ndarray:
    """Squared lengths `[N]` of `[N, 3]`."""
    return np.einsum("ij,ij->i", vectors, vectors)
