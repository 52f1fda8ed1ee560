"""Primitives of a glTF mesh as triangles with normals, texture coordinates, tangents and colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.accessors import as_floats, read_indices, read_raw
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.draco import DRACO, read_draco
from bokehguide.scene.gltf.morphs import morph
from bokehguide.scene.gltf.parts import Part
from bokehguide.scene.gltf.skins import SKINNING, blended, skinned
from bokehguide.scene.gltf.textures import uv_sets
from bokehguide.scene.shapes import unit_normals
from bokehguide.scene.types import Material, Mesh

TRIANGLES, STRIP, FAN = 4, 5, 6
KINDS = {"POSITION": ("VEC3",), "NORMAL": ("VEC3",), "COLOR_0": ("VEC3", "VEC4")}
SILENT = ("_", "TEXCOORD_", "TANGENT", "JOINTS_", "WEIGHTS_")
"""Prefixes of attributes that cause no note if they are not read. Notes name the features that use them."""


@dataclass(frozen=True)
class Deformation:
    """How a node deforms its mesh. weights: of the morph targets. joints: matrices `[J, 4, 4]` of a skin, which transform the
    mesh to world space; None without a skin."""

    weights: tuple[float, ...] = ()
    joints: np.ndarray | None = None


def read_primitive(
    document: Document, primitive: Part, name: str, number: int, material: Material, deformation: Deformation
) -> Mesh | None:
    """One primitive in its mesh's space, in world space with a skin; None without triangles.

    name: the mesh's, for notes. number, material: index and contents of the material, which selects the attributes. Raises
    BokehguideError naming file, primitive and remedy for invalid data.
    """
    if primitive.whole("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
        document.note("points and lines: left out", name)
        return None
    stored, indices = _arrays(document, primitive, _wanted(material, deformation))
    if "POSITION" not in stored:
        document.note("primitives without positions: left out", name)
        return None
    count = len(stored["POSITION"])
    triangles = _triangles(primitive, np.arange(count) if indices is None else indices)
    if len(triangles) == 0:
        return None
    if any(len(array) != count for array in stored.values()):
        counts = ", ".join(f"{len(array)} of {key}" for key, array in stored.items())
        raise BokehguideError(f"{document.file}: {primitive.path}: attributes differ in their counts ({counts}); repair the file")
    used, triangles = _compact(count, triangles)
    attributes = primitive.part("attributes")
    arrays = {key: as_floats(values[used], _is_normalized(document, attributes, key)) for key, values in stored.items()}
    morph(document, primitive, arrays, deformation.weights, used, name)
    if deformation.joints is not None:
        arrays, triangles = _posed(document, primitive, arrays, triangles, deformation.joints, name)
    vertices = arrays["POSITION"]
    normals = _normals(document, arrays.get("NORMAL"), vertices, triangles, name)
    tangents = arrays.get("TANGENT") if normals is not None else None
    return Mesh(
        vertices=vertices,
        triangles=triangles,
        material=number,
        normals=normals,
        uvs=_uvs(document, arrays, uv_sets(material), name),
        tangents=_tangents(document, tangents, name),
        colors=_colors(arrays.get("COLOR_0")),
    )


def _wanted(material: Material, deformation: Deformation) -> dict[str, tuple[str, ...]]:
    """Kinds of the attributes that a primitive of `material` needs, by name."""
    wanted = KINDS | {f"TEXCOORD_{set_}": ("VEC2",) for set_ in range(max(uv_sets(material), 1))}
    bent = material.normal_texture is not None or material.clearcoat_normal_texture is not None
    if bent or material.anisotropy > 0.0:
        wanted |= {"TANGENT": ("VEC4",)}
    return wanted if deformation.joints is None else wanted | SKINNING


def _arrays(
    document: Document, primitive: Part, wanted: dict[str, tuple[str, ...]]
) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """The `wanted` attributes by name, `[V, width]` in their stored types, and indices int64 or None."""
    attributes = primitive.part("attributes")
    packed, indices = {}, None
    if DRACO in primitive.extensions:
        packed, indices = read_draco(document, primitive)
    elif "indices" in primitive:
        indices = read_indices(document, document.required(primitive, "indices", "accessors"))
    arrays = {}
    for name in attributes.values:
        index = document.required(attributes, name, "accessors")
        if name in wanted:
            arrays[name] = packed[name] if name in packed else read_raw(document, index, *wanted[name])
        elif not name.startswith(SILENT):
            document.note(f"vertex attribute {name}: has no effect")
    return arrays, indices


def _is_normalized(document: Document, attributes: Part, name: str) -> bool:
    """Whether the integers of an attribute are fractions. Those of colours always are, although some files omit the flag."""
    index = document.required(attributes, name, "accessors")
    return name == "COLOR_0" or document.items("accessors")[index].flag("normalized")


def _triangles(primitive: Part, indices: np.ndarray) -> np.ndarray:
    """int32 `[T, 3]`. The order for strips and fans is that of glTF 2.0 section 3.7.2.1."""
    mode = primitive.whole("mode", TRIANGLES)
    # Indices beyond int32 stay out of range, so that `Mesh` rejects them.
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


def _posed(
    document: Document, primitive: Part, arrays: dict[str, np.ndarray], triangles: np.ndarray, joints: np.ndarray, name: str
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Attributes and triangles under the joint matrices `[J, 4, 4]`. A reflection reverses the vertex order."""
    matrices = blended(arrays, joints, primitive)
    if matrices is None:
        document.note("skinned meshes without joints and weights: drawn without the transform of their node", name)
        return arrays, triangles
    mirrored = np.linalg.det(matrices[:, :3, :3]).sum() < 0.0
    return skinned(arrays, matrices), np.ascontiguousarray(triangles[:, ::-1]) if mirrored else triangles


def _normals(
    document: Document, normals: np.ndarray | None, vertices: np.ndarray, triangles: np.ndarray, name: str
) -> np.ndarray | None:
    """Unit normals. Zero normals become those of the surrounding faces, with a note."""
    if normals is None:
        return None
    zeros = np.count_nonzero(~normals.any(axis=1))
    if zeros:
        document.note(f"normals of length 0: {zeros} computed from the surrounding faces", name)
    return unit_normals(normals, vertices, triangles)


def _tangents(document: Document, vectors: np.ndarray | None, name: str) -> np.ndarray | None:
    """Unit tangents `[V, 4]`; None, with a note, if any has length 0."""
    if vectors is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(vectors[:, :3], axis=1, keepdims=True)
    if not lengths.all():
        document.note("tangents of length 0: computed from the texture coordinates", name)
        return None
    unit = vectors.copy()
    with np.errstate(invalid="ignore"):
        unit[:, :3] /= lengths
    return unit


def _uvs(document: Document, arrays: dict[str, np.ndarray], sets: int, name: str) -> np.ndarray | None:
    """Texture coordinates `[V, S, 2]`. Missing sets are 0, with a note."""
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
    """RGBA `[V, 4]`, clamped to [0, 1] as in glTF 2.0 section 3.7.2.1."""
    if colors is None:
        return None
    opaque = np.ones((len(colors), 4 - colors.shape[1]), np.float32)
    return np.concatenate([colors, opaque], axis=1).clip(0.0, 1.0)


def _compact(count: int, triangles: np.ndarray) -> tuple[np.ndarray | slice, np.ndarray]:
    """The used ones of `count` vertices, and triangles without the others, if there are more vertices than triangle corners.

    Primitives often share one large vertex buffer: the time for each must not grow with the buffer. Indices out of range stay,
    for the check of `Mesh`.
    """
    if count <= triangles.size or triangles.max() >= count:
        return slice(None), triangles
    used, triangles = np.unique(triangles, return_inverse=True)
    return used, triangles.reshape(-1, 3).astype(np.int32)
