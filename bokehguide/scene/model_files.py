"""Model files (`.glb`, `.gltf`, `.obj`, `.ply`, `.stl`, `.usd`, `.usda`, `.usdc`, `.usdz`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.model import AT_REST, LightSizes, Model, ModelState

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", *USD_SUFFIXES)
FOREIGN = {
    ".blend": "export it from Blender as glTF (File > Export > glTF 2.0) and give the .glb",
    **dict.fromkeys((".3ds", ".abc", ".dae", ".fbx"), "convert it to glTF, with Blender for example, and give the .glb"),
    **dict.fromkeys((".step", ".stp"), "convert it to a mesh, with FreeCAD for example, and give the .stl"),
}
"""Formats that are not read, each with what to do."""


def refuse_format(path: Path, place: str) -> None:
    """Raise BokehguideError, naming `place`, for a file in one of the formats FOREIGN."""
    remedy = FOREIGN.get(path.suffix.lower())
    if remedy is not None:
        raise BokehguideError(f"{place}: a {path.suffix.lower()} file; {remedy}")


def load_model(
    path: Path, files: SceneFiles | None = None, sizes: LightSizes | None = None, state: ModelState = AT_REST
) -> Model:
    """Read a model file. Instances become triangles; the file's normals are kept.

    files: the files that the model may name, by default those in its folder. sizes: of a glTF file's lights. state: variant
    and time of a glTF or USD file. Raises BokehguideError for a missing, damaged or empty file, values that are not
    finite, indices out of range, and a state that the file does not have.
    """
    refuse_format(path, str(path))
    if path.suffix.lower() not in MODEL_SUFFIXES:
        raise BokehguideError(f"{path}: is no model; give a file with one of the suffixes {' '.join(MODEL_SUFFIXES)}")
    require_file(path, "model")
    files = files or SceneFiles(path.parent)
    if path.suffix.lower() in (".glb", ".gltf"):
        from bokehguide.scene.gltf import load_gltf

        model = load_gltf(path, files, sizes or LightSizes(), state)
    elif path.suffix.lower() in USD_SUFFIXES:
        from bokehguide.scene.usd import load_usd

        model = load_usd(path, files, state)
    else:
        if state != AT_REST:
            raise BokehguideError(f"{path}: has neither variants nor animations; leave variant and time out, or give a glTF file")
        from bokehguide.scene.mesh_files import load_mesh_file

        model = load_mesh_file(path, files)
    if not model.meshes:
        raise BokehguideError(f"{path}: holds no triangles; give a model with a surface")
    named = {key: tuple(f"{path.name}: {line}" for line in getattr(model, key)) for key in ("supported", "warnings")}
    return replace(model, **named)
