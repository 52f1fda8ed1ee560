"""Primitives of a glTF mesh: triangles, normals, texture coordinates, tangents, colours."""

from __future__ import annotations

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.accessors import as_floats, read_indices, read_raw
from bokehguide.scene.gltf.document import Document, Part
from bokehguide.scene.gltf.draco import DRACO, read_draco
from bokehguide.scene.gltf.skins import SKINNING, blended, skinned
from bokehguide.scene.gltf.textures import uv_sets
from bokehguide.scene.shapes import unit_normals
from bokehguide.scene.types import Material, Mesh

TRIANGLES, STRIP, FAN = 4, 5, 6
KINDS = {"POSITION": ("VEC3",), "NORMAL": ("VEC3",), "COLOR_0": ("VEC3", "VEC4")}
UNSEEN = ("_", "TEXCOORD_", "TANGENT", "JOINTS_", "WEIGHTS_")
"""Attributes that need no mention where they are not read: their users are mentioned."""


def read_primitive(
    document: Document, primitive: Part, name: str, number: int, material: Material, joints: np.ndarray | None = None
) -> Mesh | None:
    """One primitive in its mesh's own space, None where it holds no triangles.

    joints: matrices `[J, 4, 4]` of a skin, which put it into the world. name: the mesh's, for what is to be noted. number: that of its `material`, which
    says what is needed: texture coordinates beyond the first set, tangents.
    """
    if primitive.whole("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
        document.note("points and lines: left out", name)
        return None
    if primitive.values.get("targets"):
        document.note("morph targets: the model is drawn at rest", name)
    wanted = KINDS | {f"TEXCOORD_{set_}": ("VEC2",) for set_ in range(max(uv_sets(material), 1))}
    if material.normal_texture is not None or material.clearcoat_normal_texture is not None:
        wanted |= {"TANGENT": ("VEC4",)}
    if joints is not None:
        wanted |= SKINNING
    arrays, indices = _arrays(document, primitive, wanted)
    if "POSITION" not in arrays:
        document.note("primitives without positions: left out", name)
        return None
    vertices = arrays["POSITION"]
    triangles = _triangles(primitive, np.arange(len(vertices)) if indices is None else indices)
    if len(triangles) == 0:
        return None
    if any(len(array) != len(vertices) for array in arrays.values()):
        counts = ", ".join(f"{len(array)} of {key}" for key, array in arrays.items())
        raise BokehguideError(
            f"{document.file}: {primitive.path}: attributes differ in their counts ({counts}); repair the file"
        )
    matrices = None if joints is None else blended(arrays, joints, primitive)
    if joints is not None and matrices is None:
        document.note("skinned meshes without joints and weights: stand where no node has moved them", name)
    if matrices is not None:
        arrays = skinned(arrays, matrices)
        vertices = arrays["POSITION"]
        if np.linalg.det(matrices[:, :3, :3]).sum() < 0.0:  # mirrored: the front stays the front
            triangles = np.ascontiguousarray(triangles[:, ::-1])
    normals = _normals(document, arrays.get("NORMAL"), vertices, triangles, name)
    tangents = arrays.get("TANGENT") if normals is not None else None
    mesh = Mesh(
        vertices=vertices,
        triangles=triangles,
        material=number,
        normals=normals,
        uvs=_uvs(document, arrays, uv_sets(material), name),
        tangents=_tangents(document, tangents, name),
        colors=_colors(arrays.get("COLOR_0")),
    )
    return _compact(mesh)


def _arrays(
    document: Document, primitive: Part, wanted: dict[str, tuple[str, ...]]
) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """The `wanted` attributes by name, float32 `[V, width]`, and indices int64 or None."""
    attributes = primitive.part("attributes")
    packed, indices = {}, None
    if DRACO in primitive.extensions:
        packed, indices = read_draco(document, primitive)
    elif "indices" in primitive:
        indices = read_indices(document, document.link(primitive, "indices", "accessors"))
    arrays = {}
    for name in attributes.values:
        index = document.link(attributes, name, "accessors")
        if name in wanted:
            values = packed[name] if name in packed else read_raw(document, index, *wanted[name])
            # Colours in integers have no other meaning, and some files forget to say so.
            normalized = name == "COLOR_0" or document.items("accessors")[index].flag("normalized")
            arrays[name] = as_floats(values, normalized)
        elif not name.startswith(UNSEEN):
            document.note(f"vertex attribute {name}: has no effect")
    return arrays, indices


def _triangles(primitive: Part, indices: np.ndarray) -> np.ndarray:
    """int32 `[T, 3]`; glTF 2.0 section 3.7.2.1 has the order of strips and fans."""
    mode = primitive.whole("mode", TRIANGLES)
    # What is too large for int32 stays out of range, where it will be found.
    indices = np.minimum(indices, np.iinfo(np.int32).max).astype(np.int32)
    if mode == TRIANGLES:
        if len(indices) % 3:
            problem = f"{len(indices)} indices are no whole number of triangles; repair the file"
            raise BokehguideError(f"{primitive.file}: {primitive.path}: {problem}")
        return indices.reshape(-1, 3)
    start = np.arange(max(len(indices) - 2, 0))
    if mode == STRIP:
        return np.stack([indices[start], indices[start + 1 + start % 2], indices[start + 2 - start % 2]], axis=1)
    return np.stack([indices[start + 1], indices[start + 2], indices[np.zeros_like(start)]], axis=1)


def _normals(
    document: Document, normals: np.ndarray | None, vertices: np.ndarray, triangles: np.ndarray, name: str
) -> np.ndarray | None:
    """Normals at length one; those without a direction, which are noted, are made from the faces around."""
    if normals is None:
        return None
    lost = np.count_nonzero(~normals.any(axis=1))
    if lost:
        document.note(f"normals of length 0: {lost} made from the faces around them", name)
    return unit_normals(normals, vertices, triangles)


def _tangents(document: Document, vectors: np.ndarray | None, name: str) -> np.ndarray | None:
    """Tangents with xyz at length one; None, with a note, where one has no direction."""
    if vectors is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(vectors[:, :3], axis=1, keepdims=True)
    if not lengths.all():
        document.note("tangents of length 0: made from the texture coordinates", name)
        return None
    unit = vectors.copy()
    with np.errstate(invalid="ignore"):
        unit[:, :3] /= lengths
    return unit


def _uvs(document: Document, arrays: dict[str, np.ndarray], sets: int, name: str) -> np.ndarray | None:
    """`[V, S, 2]`; a set that the material asks for and the mesh has not is 0 everywhere."""
    wanted = [f"TEXCOORD_{number}" for number in range(max(sets, 1))]
    if not any(key in arrays for key in wanted):
        if sets:
            document.note("textures without texture coordinates: their first texel is used", name)
        return None
    absent = np.zeros((len(arrays["POSITION"]), 2), np.float32)
    for key in wanted[1:]:
        if key not in arrays:
            document.note(f"textures without their {key}: their first texel is used", name)
    return np.stack([arrays.get(key, absent) for key in wanted], axis=1)


def _colors(colors: np.ndarray | None) -> np.ndarray | None:
    """RGBA within 0 … 1, to which glTF 2.0 section 3.7.2.1 clamps them."""
    if colors is None:
        return None
    opaque = np.ones((len(colors), 4 - colors.shape[1]), np.float32)
    return np.concatenate([colors, opaque], axis=1).clip(0.0, 1.0)


def _compact(mesh: Mesh) -> Mesh:
    """Without the vertices that no triangle uses, where there must be such.

    Primitives often share one long vertex buffer. Indices out of range stay for the check.
    """
    if len(mesh.vertices) <= mesh.triangles.size or mesh.triangles.max() >= len(mesh.vertices):
        return mesh
    used, triangles = np.unique(mesh.triangles, return_inverse=True)
    kept = {
        name: None if getattr(mesh, name) is None else getattr(mesh, name)[used]
        for name in ("vertices", "normals", "uvs", "tangents", "colors")
    }
    return Mesh(triangles=triangles.reshape(-1, 3).astype(np.int32), material=mesh.material, **kept)
