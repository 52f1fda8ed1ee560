"""Models (`.glb .gltf .obj .ply .stl`) as world-space meshes and materials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.types import LightSizes, Model


def load_model(path: Path, sizes: LightSizes = LightSizes(), files: SceneFiles | None = None) -> Model:
    """Read a model; instances are flattened, the file's normals kept.

    sizes: of a glTF file's lights. files: what it may read, by default what lies in its folder.
    Raises BokehguideError for a missing, damaged or empty file, for vertices that are not
    finite and indices that are out of range.
    """
    require_file(path, "model")
    files = SceneFiles(path.parent) if files is None else files
    if path.suffix.lower() in (".glb", ".gltf"):
        from bokehguide.scene.gltf import load_gltf

        model = load_gltf(path, sizes, files)
    else:
        from bokehguide.scene.plain_models import load_plain

        model = load_plain(path, files)
    if not model.meshes:
        raise BokehguideError(f"{path}: holds no triangles; give a model with a surface")
    named = {key: tuple(f"{path.name}: {line}" for line in getattr(model, key)) for key in ("honoured", "warnings")}
    return replace(model, **named)
