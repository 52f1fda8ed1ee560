"""What must hold of any scene before it reaches the renderer.

Embree reads past its arrays where an index is out of range, so nothing here is optional.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.types import Mesh, Scene


def checked(scene: Scene) -> Scene:
    """`scene` without its zero-area triangles and the meshes that had no others.

    Raises BokehguideError where a vertex, normal or uv is not finite, an index is out
    of range, or nothing is left to see.
    """
    for number, mesh in enumerate(scene.meshes):
        check_mesh(mesh, f"{scene.name}: mesh {number}", len(scene.materials))
    meshes = tuple(mesh for mesh in map(_without_degenerate, scene.meshes) if len(mesh.triangles))
    if not meshes:
        raise BokehguideError(
            f"{scene.name}: holds no triangle with an area; add an object or a model with a surface"
        )
    return replace(scene, meshes=meshes, warnings=tuple(dict.fromkeys(scene.warnings)))


def check_mesh(mesh: Mesh, place: str, materials: int) -> None:
    """Raise BokehguideError, naming `place`, where `mesh` is not finite or not consistent."""
    count = len(mesh.vertices)
    for name, width in (("vertices", 3), ("normals", 3), ("uvs", 2)):
        values = getattr(mesh, name)
        if values is None:
            continue
        if values.shape != (count, width):
            raise BokehguideError(
                f"{place}: {name} has shape {values.shape}, not {(count, width)}; repair the model"
            )
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise BokehguideError(
                f"{place}: {name}[{bad[0]}] is {values[bad[0]].tolist()}, not finite; "
                f"repair the model ({len(bad)} such)"
            )
    out = np.flatnonzero(((mesh.triangles < 0) | (mesh.triangles >= count)).any(axis=1))
    if len(out):
        raise BokehguideError(
            f"{place}: triangle {out[0]} has the indices {mesh.triangles[out[0]].tolist()}, but "
            f"there are {count} vertices; repair the model ({len(out)} such)"
        )
    if not 0 <= mesh.material < materials:
        raise BokehguideError(f"{place}: material {mesh.material} of {materials} does not exist")


def _without_degenerate(mesh: Mesh) -> Mesh:
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    doubled_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)], axis=0)
    # Below this, single precision computes a normal that is noise or whose square is 0.
    kept = doubled_area > np.maximum(1e-7 * longest**2, 1e-18)
    return mesh if kept.all() else replace(mesh, triangles=mesh.triangles[kept])
