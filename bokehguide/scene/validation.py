"""Checks of whole scenes. The dataclasses of `types` check their own fields.

Embree reads outside its arrays if an index is out of range, so no check is optional.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.limits import MAX_SUNS, MAX_TRIANGLES
from bokehguide.scene.types import Mesh, Scene


def checked(scene: Scene, place: str) -> Scene:
    """`scene` without triangles of zero area and without meshes that have no other triangles.

    Removed emitters cause a warning. place: the user's name of the scene, such as its file. Raises
    BokehguideError, naming `place`, for too many triangles and for no remaining triangle.
    """
    check_triangles(sum(len(mesh.triangles) for mesh in scene.meshes), place)
    if len(scene.suns) > MAX_SUNS:
        raise BokehguideError(f"{place}: has {len(scene.suns):,} suns; give at most {MAX_SUNS}")
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
    a, b, c = np.moveaxis(mesh.vertices.T.astype(np.float64)[:, mesh.triangles], 2, 0)
    one, other = b - a, c - a
    (x, y, z), (u, v, w) = one, other
    doubled_area = np.sqrt((y * w - z * v) ** 2 + (z * u - x * w) ** 2 + (x * v - y * u) ** 2)
    longest = np.maximum(np.maximum(_squares(one), _squares(c - b)), _squares(other))
    # A smaller area gives a normal that is rounding noise, or whose square underflows, in single precision.
    kept = doubled_area > np.maximum(1e-7 * longest, 1e-18)
    return mesh if kept.all() else replace(mesh, triangles=mesh.triangles[kept])


def _squares(vectors: np.ndarray) -> np.ndarray:
    """Squared lengths `[N]` of `[3, N]`."""
    x, y, z = vectors
    return x * x + y * y + z * z
