"""Shapes of pbrt as meshes in their own space. Front faces are those of pbrt's normals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bokehguide.scene.files import SceneFiles
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.pbrt.ply import read_ply
from bokehguide.scene.pbrt.quadrics import cone, cylinder, disk, hyperboloid, paraboloid, sphere
from bokehguide.scene.shapes import facing_normals, unit_normals
from bokehguide.scene.types import Mesh
from bokehguide.scene.uvs import turned_uvs
from bokehguide.scene.validation import check_triangles

MAX_LEVELS = 8
"""Subdivisions of a mesh; each makes four times the triangles."""


@dataclass(frozen=True)
class Read:
    """A shape as a mesh. count: of pbrt's shapes that the mesh stands for, which share its area; each has a light of its own."""

    mesh: Mesh
    count: int


def read_shape(parameters: Parameters, folder: Path, files: SceneFiles, segments: int) -> Read | None:
    """The mesh of a shape, None for a kind without a counterpart. segments: of a full turn of a quadric.

    Raises BokehguideError for missing and damaged data.
    """
    if parameters.kind in QUADRICS:
        return Read(QUADRICS[parameters.kind](parameters, segments), 1)
    read = READERS.get(parameters.kind)
    return None if read is None else read(parameters, folder, files)


def triangles_mesh(
    points: np.ndarray, triangles: np.ndarray, normals: np.ndarray | None, uvs: np.ndarray | None, parameters: Parameters
) -> Mesh:
    """A mesh of triangles that face the side of the normals of their vertices.

    points, normals: `[V, 3]`. triangles: `[T, 3]`. uvs: `[V, 2]` with v upwards. Raises BokehguideError for an index out of
    range and for other numbers of normals or uvs.
    """
    count = len(points)
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < count):
        parameters.place.fail(f"{parameters.kind}: an index is beyond its {count} vertices; repair it")
    for what, values in (("normals", normals), ("uvs", uvs)):
        if values is not None and len(values) != count:
            parameters.place.fail(f"{parameters.kind}: {len(values)} {what} of {count} vertices; give one for each")
    points = points.astype(np.float32)
    if normals is not None:
        normals = unit_normals(normals.astype(np.float32), points, triangles)
    downwards = None if uvs is None else turned_uvs(uvs)[:, None]
    return facing_normals(Mesh(points, triangles.astype(np.int32), 0, normals, downwards))


def _vertices(parameters: Parameters) -> np.ndarray:
    """The vertices of a mesh `[V, 3]`."""
    points = parameters.numbers("P", 3)
    if points is None:
        parameters.place.fail(f'{parameters.kind} without vertices; give "point3 P"')
    return points


def _uvs(parameters: Parameters) -> np.ndarray | None:
    """Texture coordinates `[V, 2]`."""
    return parameters.numbers("uv" if "uv" in parameters else "st", 2)


def _indices(parameters: Parameters, corners: int, count: int) -> np.ndarray:
    """Indices `[N, corners]`; those of the first face without the parameter, if the vertices are its corners."""
    values = parameters.integers("indices")
    if values is None and count == corners:
        return np.arange(corners)[None]
    if values is None or len(values) % corners:
        parameters.place.fail(f'{parameters.kind}: give "integer indices", a multiple of {corners}')
    return values.reshape(-1, corners)


def _triangle_mesh(parameters: Parameters, folder: Path, files: SceneFiles) -> Read:
    points = _vertices(parameters)
    triangles = _indices(parameters, 3, len(points))
    mesh = triangles_mesh(points, triangles, parameters.numbers("N", 3), _uvs(parameters), parameters)
    return Read(mesh, len(triangles))


def quads_as_triangles(quads: np.ndarray) -> np.ndarray:
    """Two triangles `[2 Q, 3]` of each patch with the corners (0, 0), (1, 0), (0, 1) and (1, 1)."""
    return quads[:, [[0, 1, 3], [0, 3, 2]]].reshape(-1, 3)


def _bilinear_mesh(parameters: Parameters, folder: Path, files: SceneFiles) -> Read:
    points = _vertices(parameters)
    quads = _indices(parameters, 4, len(points))
    uvs = _uvs(parameters)
    if uvs is None and len(points) == 4:
        uvs = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float64)[np.argsort(quads[0])]
    mesh = triangles_mesh(points, quads_as_triangles(quads), parameters.numbers("N", 3), uvs, parameters)
    return Read(mesh, len(quads))


def _loop_mesh(parameters: Parameters, folder: Path, files: SceneFiles) -> Read:
    """The subdivided mesh with smooth normals."""
    from trimesh import Trimesh

    points, levels = _vertices(parameters), int(parameters.number("levels", 3))
    mesh = triangles_mesh(points, _indices(parameters, 3, len(points)), None, None, parameters)
    if not 0 <= levels <= MAX_LEVELS:
        parameters.fail("levels", f"is out of range; give 0 to {MAX_LEVELS}")
    check_triangles(len(mesh.triangles) * 4**levels, str(parameters.place), files.most_triangles)
    smooth = Trimesh(mesh.vertices, mesh.triangles, process=False)
    try:
        smooth = smooth.subdivide_loop(levels) if levels > 0 else smooth
    except ValueError:  # an edge of three triangles
        parameters.place.fail("loopsubdiv: more than two triangles share an edge; repair the mesh")
    faces = np.asarray(smooth.faces)
    normals = unit_normals(np.zeros((len(smooth.vertices), 3), np.float32), np.asarray(smooth.vertices, np.float32), faces)
    return Read(triangles_mesh(np.asarray(smooth.vertices), faces, normals, None, parameters), len(faces))


def _ply_mesh(parameters: Parameters, folder: Path, files: SceneFiles) -> Read:
    path = files.find(folder, parameters.text("filename"), str(parameters.place))
    points, triangles, normals, uvs = read_ply(path, files, str(parameters.place))
    return Read(triangles_mesh(points, triangles, normals, uvs, parameters), len(triangles))


Reader = Callable[[Parameters, Path, SceneFiles], Read]
READERS: dict[str, Reader] = {
    "trianglemesh": _triangle_mesh,
    "bilinearmesh": _bilinear_mesh,
    "loopsubdiv": _loop_mesh,
    "plymesh": _ply_mesh,
}
"""Readers of meshes by the name of the plugin, before their transform."""
QUADRICS = {"sphere": sphere, "disk": disk, "cylinder": cylinder}
QUADRICS |= {"cone": cone, "paraboloid": paraboloid, "hyperboloid": hyperboloid}
"""Makers of quadrics, which may have fewer triangles in scenes of many."""
