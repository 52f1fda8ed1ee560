"""Models (`.glb .gltf .obj .ply .stl`) as world-space meshes and materials."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from bokehguide.errors import BokehguideError
from bokehguide.scene.images import require_file, texture_from_image
from bokehguide.scene.shapes import transformed
from bokehguide.scene.tables import NOT_NEGATIVE, Table
from bokehguide.scene.types import Material, Mesh, Texture
from bokehguide.scene.validation import check_mesh


@dataclass(frozen=True)
class Model:
    """Surfaces in the model's own space, and what of the file was not honoured."""

    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    warnings: tuple[str, ...]


def load_model(path: Path) -> Model:
    """Read a model; instances are flattened, the file's normals kept.

    Raises BokehguideError for a missing, damaged or empty file, for vertices that are
    not finite and indices that are out of range.
    """
    require_file(path, "model")
    try:
        scene, materials, index, warnings = _read(path)
    except BokehguideError:
        raise
    except Exception as error:  # the parsers raise whatever a damaged file trips them into
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BokehguideError(f"{path}: not a readable {path.suffix} model ({reason})") from None
    meshes = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            continue
        mesh = _mesh(geometry, index[name])
        check_mesh(mesh, f"{path}: {name}", len(materials))
        placed = transformed(mesh, matrix)
        check_mesh(placed, f"{path}: {node}", len(materials))
        meshes.append(placed)
    if not meshes:
        raise BokehguideError(f"{path}: holds no triangles; give a model with a surface")
    return Model(tuple(meshes), tuple(materials), tuple(f"{path.name}: {w}" for w in warnings))


def _read(path: Path) -> tuple[trimesh.Scene, list[Material], dict[str, int], list[str]]:
    """trimesh's scene, the materials, the material of each geometry, and warnings."""
    if path.suffix.lower() in (".glb", ".gltf"):
        from bokehguide.scene.gltf import gltf_materials, read_gltf
        from bokehguide.scene.ignored import ignored_features

        document, scene = read_gltf(path)
        materials = gltf_materials(document, scene, str(path))
        index = {name: _gltf_index(g, len(materials)) for name, g in scene.geometry.items()}
        if len(materials) in index.values():
            # glTF's default: every factor 1, so a rough white metal.
            materials.append(Material("default", base_color=(1.0, 1.0, 1.0), metallic=1.0))
        return scene, materials, index, ignored_features(document)
    scene = trimesh.load_scene(str(path), process=False)
    materials, index, warnings = [], {}, []
    for name, geometry in scene.geometry.items():
        index[name] = len(materials)
        materials.append(_plain_material(geometry, name, str(path)))
        if geometry.visual.kind in ("vertex", "face"):
            warnings.append("vertex and face colours: have no effect")
        if getattr(getattr(geometry.visual, "material", None), "kwargs", None):
            warnings.append("of its .mtl file only Kd, map_Kd and Ke are honoured")
    return scene, materials, index, warnings


def _gltf_index(geometry: Any, default: int) -> int:
    material = getattr(geometry.visual, "material", None)
    name = getattr(material, "name", None)
    return int(name) if name is not None and name.isdigit() else default


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
    """float32 arrays of a geometry; trimesh's v points up, glTF's and ours down."""
    normals = None
    # trimesh computes normals on demand; only those of the file are in its cache yet.
    if "vertex_normals" in geometry._cache:
        normals = np.asarray(geometry.vertex_normals, dtype=np.float32)
        if not np.isfinite(normals).all() or not np.linalg.norm(normals, axis=1).all():
            normals = None
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
