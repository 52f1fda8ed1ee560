"""Models in `.obj`, `.ply` and `.stl`, by way of trimesh."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import texture_from_image
from bokehguide.scene.shapes import transformed, unit_normals
from bokehguide.scene.tables import NOT_NEGATIVE, Table
from bokehguide.scene.types import Material, Mesh, Model, Texture
from bokehguide.scene.validation import check_mesh


# Or what trimesh logs, tracebacks among it, would go to the terminal of who has set up no logging.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


MTL_TERMS = {"kd", "ke", "map_kd"}
"""Of an .obj's materials, what is honoured."""


class _Beside(FilePathResolver):
    """Gives trimesh the files that a model names, as far as the scene may read them."""

    def __init__(self, model: Path, files: SceneFiles):
        super().__init__(str(model))
        self.model, self.files = model, files
        self.refusal: BokehguideError | None = None
        self.missing: list[str] = []

    def get(self, name: str) -> bytes:
        """The file `name` or, as such names often come from another disk, its last part beside the model.

        trimesh goes on without a file that it does not get: the first refusal is kept.
        """
        refusal = None
        for candidate in (name.strip(), PureWindowsPath(name.strip()).name):
            try:
                path = self.files.find(self.model.parent, candidate, str(self.model))
            except BokehguideError as error:
                refusal = refusal or error
                continue
            if path.is_file():
                data = path.read_bytes()
                self.files.unfold(0, len(data), str(self.model))
                return data
        self.refusal = self.refusal or refusal
        self.missing.append(name)
        raise FileNotFoundError(name)


def load_plain(path: Path, files: SceneFiles) -> Model:
    """Read a model as `load_model` does."""
    scene, warnings = _parsed(path, files)
    materials, index, ignored = [], {}, set()
    for name, geometry in scene.geometry.items():
        index[name] = len(materials)
        materials.append(_material(geometry, printable(name), path, files))
        if geometry.visual.kind in ("vertex", "face"):
            warnings.append("vertex and face colours: have no effect")
        ignored |= {*(getattr(getattr(geometry.visual, "material", None), "kwargs", None) or ())} - MTL_TERMS
    meshes = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            continue
        mesh = _mesh(geometry, index[name])
        check_mesh(mesh, f"{path}: {printable(name)}", len(materials))
        if mesh.normals is not None:
            mesh = replace(mesh, normals=unit_normals(mesh.normals, mesh.vertices, mesh.triangles))
        meshes.append(transformed(mesh, matrix))
    if ignored:
        terms = printable(", ".join(sorted(map(str, ignored))), 200)
        warnings.append(f".mtl file: {terms}: have no effect, only Kd, map_Kd and Ke do")
    return Model(tuple(meshes), tuple(materials), warnings=tuple(warnings))


def _parsed(path: Path, files: SceneFiles) -> tuple[trimesh.Scene, list[str]]:
    """What trimesh makes of the file, and warnings of what it named and was not there."""
    beside = _Beside(path, files)
    try:
        scene = trimesh.load_scene(str(path), resolver=beside, process=False)
    except Exception as error:  # the parsers raise whatever a damaged file trips them into
        raise BokehguideError(f"{path}: not a readable {path.suffix} model ({reason(error)})") from None
    if beside.refusal is not None:
        raise beside.refusal
    return scene, [f"{printable(name)}: no such file; left out" for name in beside.missing]


def _material(geometry: Any, name: str, path: Path, files: SceneFiles) -> Material:
    """What an `.obj` says of a surface; `.ply` and `.stl` say nothing."""
    material = getattr(geometry.visual, "material", None)
    terms = getattr(material, "kwargs", None) or {}
    image = getattr(material, "image", None)
    if image is not None and image.format is None:  # from no file: trimesh's own, for coordinates without an image
        image = None
    label = printable(getattr(material, "name", None) or name)
    values = {key: _numbers(terms[key]) for key in ("kd", "ke") if key in terms}
    table = Table(values, str(path), f"material {label}", values)
    return Material(
        name=name,
        base_color=tuple(min(channel, 1.0) for channel in table.vector("kd", Material.base_color, NOT_NEGATIVE)),
        emission=table.vector("ke", Material.emission, NOT_NEGATIVE),
        base_color_texture=None if image is None else Texture(texture_from_image(image, f"{path}: {label}", files)),
    )


def _numbers(words: Any) -> Any:
    """The numbers that trimesh read, or left as words; what is none stays as it is."""
    try:
        return [float(word) for word in words]
    except (TypeError, ValueError):
        return words


def _mesh(geometry: trimesh.Trimesh, material: int) -> Mesh:
    """float32 arrays of a geometry; trimesh's v points up, ours down."""
    normals = None
    # trimesh computes normals on demand; only those of the file are in its cache yet.
    if "vertex_normals" in geometry._cache:
        normals = np.asarray(geometry.vertex_normals, dtype=np.float32)
        normals = normals if np.isfinite(normals).all() else None
    uvs = getattr(geometry.visual, "uv", None)
    if uvs is not None:
        uvs = np.asarray(uvs, dtype=np.float32)[:, :2] * (1, -1) + (0, 1)
    with np.errstate(over="ignore"):
        vertices = np.asarray(geometry.vertices, dtype=np.float32)
    return Mesh(
        vertices=vertices,
        triangles=np.asarray(geometry.faces, dtype=np.int32),
        material=material,
        normals=normals,
        uvs=None if uvs is None else uvs.astype(np.float32)[:, None],
    )
