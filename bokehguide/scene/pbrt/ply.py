"""PLY files with normals and texture coordinates, read with trimesh; also compressed as `.ply.gz`."""

from __future__ import annotations

import logging
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError, reason
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.pbrt.tokens import read_bytes
from bokehguide.stopping import default_signals

# Without a handler, Python prints the log of trimesh, which includes tracebacks, to the terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

UV_NAMES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
"""Names of the properties that hold texture coordinates."""
Ply = tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]


def read_ply(path: Path, files: SceneFiles, place: str) -> Ply:
    """Points `[V, 3]`, triangles `[T, 3]`, normals `[V, 3]` or None, and uvs `[V, 2]` or None; v points upwards.

    place: where the file is named. Raises BokehguideError for a missing, damaged or empty file.
    """
    import trimesh

    require_file(path, "model", place)
    data = read_bytes(path, files)
    try:
        with default_signals():  # parts of trimesh hold the interpreter's lock
            mesh: Any = trimesh.load(BytesIO(data), file_type="ply", process=False)
        columns = mesh.metadata["_ply_raw"]["vertex"]["data"]
        triangles = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
        points = _columns(columns, "xyz")
    except Exception as error:  # the parser raises exceptions of any type for damaged files
        raise BokehguideError(f"{path}: not a readable .ply model ({reason(error)})") from None
    if points is None or len(triangles) == 0:
        raise BokehguideError(f"{path}: holds no triangles; give a model with a surface")
    normals = _columns(columns, ("nx", "ny", "nz"))
    uvs = next((found for names in UV_NAMES if (found := _columns(columns, names)) is not None), None)
    return points, triangles, normals, uvs


def _columns(columns: Any, names: str | tuple[str, ...]) -> np.ndarray | None:
    """Properties of the vertices side by side, float64 `[V, C]`; None if one is missing or not finite."""
    known = getattr(getattr(columns, "dtype", None), "names", None) or (columns if isinstance(columns, dict) else ())
    if not all(name in known for name in names):
        return None
    values = np.stack([np.asarray(columns[name], np.float64).reshape(-1) for name in names], axis=1)
    return values if np.isfinite(values).all() else None
