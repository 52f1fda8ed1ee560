"""Models (`.glb .gltf .obj .ply .stl`) as world-space meshes and materials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from bokehguide.errors import BokehguideError
from bokehguide.scene.images import require_file, texture_from_image
from bokehguide.scene.shapes import transformed, unit_normals
from bokehguide.scene.tables import NOT_NEGATIVE, Table
from bokehguide.scene.types import LightSizes, Material, Mesh, Model, Texture
from bokehguide.scene.validation import check_mesh


MTL_TERMS = {"kd", "ke", "map_kd"}
"""Of an .obj's materials, what is honoured."""


def load_model(path: Path, sizes: LightSizes = LightSizes()) -> Model:
    """Read a model; instances are flattened, the file's normals kept.

    sizes: of a glTF file's lights. Raises BokehguideError for a missing, damaged or empty
    file, for vertices that are not finite and indices that are out of range.
    """
    require_file(path, "model")
    if path.suffix.lower() in (".glb", ".gltf"):
        from bokehguide.scene.gltf import load_gltf

        model = load_gltf(path, sizes)
    else:
        try:
            model = _read_plain(path)
        except BokehguideError:
            raise
        except Exception as error:  # the parsers raise whatever a damaged file trips them into
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise BokehguideError(f"{path}: not a readable {path.suffix} model ({reason})") from None
    if not model.meshes:
        raise BokehguideError(f"{path}: holds no triangles; give a model with a surface")
    named = {key: tuple(f"{path.name}: {line}" for line in getattr(model, key)) for key in ("honoured", "warnings")}
    return replace(model, **named)


def _read_plain(path: Path) -> Model:
    """A `.obj`, `.ply` or `.stl`, by way of trimesh."""
    scene = trimesh.load_scene(str(path), process=False)
    materials, index, warnings, ignored = [], {}, [], set()
    for name, geometry in scene.geometry.items():
        index[name] = len(materials)
        materials.append(_plain_material(geometry, name, str(path)))
        if geometry.visual.kind in ("vertex", "face"):
            warnings.append("vertex and face colours: have no effect")
        ignored |= {*(getattr(getattr(geometry.visual, "material", None), "kwargs", None) or ())} - MTL_TERMS
    meshes = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            continue
        mesh = transformed(_mesh(geometry, index[name]), matrix)
        check_mesh(mesh, f"{path}: {name}", len(materials))
        meshes.append(mesh)
    if ignored:
        warnings.append(f".mtl file: {', '.join(sorted(ignored))}: have no effect, only Kd, map_Kd and Ke do")
    return Model(tuple(meshes), tuple(materials), warnings=tuple(warnings))


def _plain_material(geometry: Any, name: str, file: str) -> Material:
    """What an `.obj` says of a surface; `.ply` and `.stl` say nothing."""
    material = getattr(geometry.visual, "material", None)
    terms = getattr(material, "kwargs", None) or {}
    image = getattr(material, "image", None)
    values = {key: [float(channel) for channel in terms[key]] for key in ("kd", "ke") if key in terms}
    table = Table(values, file, f"material {getattr(material, 'name', None) or name}", values)
    return Material(
        name=name,
        base_color=tuple(min(channel, 1.0) for channel in table.vector("kd", Material.base_color, NOT_NEGATIVE)),
        emission=table.vector("ke", Material.emission, NOT_NEGATIVE),
        base_color_texture=None if image is None else Texture(texture_from_image(image, srgb=True)),
    )


def _mesh(geometry: trimesh.Trimesh, material: int) -> Mesh:
    """float32 arrays of a geometry; trimesh's v points up, ours down."""
    normals = None
    # trimesh computes normals on demand; only those of the file are in its cache yet.
    if "vertex_normals" in geometry._cache:
        normals = np.asarray(geometry.vertex_normals, dtype=np.float32)
        normals = unit_normals(normals, geometry.vertices, geometry.faces) if np.isfinite(normals).all() else None
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
