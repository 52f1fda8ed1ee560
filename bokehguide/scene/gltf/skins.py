"""Skins: vertices that follow the nodes of a skeleton, where the file leaves these at rest.

glTF 2.0 section 3.7.3.3: a vertex is Σ w J B v, with J the world matrix of a joint and B its
inverse bind matrix. The transform of the node that holds the mesh is ignored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.accessors import read_floats
from bokehguide.scene.gltf.document import Document, Part
from bokehguide.scene.gltf.nodes import Placed

INFLUENCES = 8
"""Sets of four joints that a vertex may have at most."""
SKINNING = {f"{name}_{number}": ("VEC4",) for name in ("JOINTS", "WEIGHTS") for number in range(INFLUENCES)}
"""The attributes that say which joints a vertex follows, and their types."""


def joint_matrices(document: Document, node: Part, placed: Sequence[Placed]) -> np.ndarray | None:
    """World matrices J B `[joints, 4, 4]` of the skin of `node`; None where it has no skin.

    Raises BokehguideError for a joint that is no node of the scene, and for a missing inverse bind matrix.
    """
    index = document.link(node, "skin", "skins")
    if index is None:
        return None
    skin = document.items("skins")[index]
    world = {one.node.path: one.matrix for one in placed}
    joints = [document.items("nodes")[joint].path for joint in document.links(skin, "joints", "nodes")]
    if not joints or any(joint not in world for joint in joints):
        skin.fail("joints", "is not a list of nodes of the scene; repair the file")
    matrices = np.stack([world[joint] for joint in joints])
    bind = document.link(skin, "inverseBindMatrices", "accessors")
    if bind is None:
        return matrices
    inverse = read_floats(document, bind, "MAT4").astype(np.float64)
    if len(inverse) < len(joints):
        skin.fail("inverseBindMatrices", f"has {len(inverse)} matrices for {len(joints)} joints; repair the file")
    return matrices @ inverse[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)


def blended(arrays: Mapping[str, np.ndarray], matrices: np.ndarray, primitive: Part) -> np.ndarray | None:
    """The matrix of each vertex, float64 `[V, 4, 4]`, from its joints and weights; None where it has none of them.

    Raises BokehguideError for a joint that the skin does not have.
    """
    sets = [n for n in range(INFLUENCES) if f"JOINTS_{n}" in arrays and f"WEIGHTS_{n}" in arrays]
    if not sets:
        return None
    joints = np.concatenate([arrays[f"JOINTS_{n}"] for n in sets], axis=1).astype(np.int64)
    weights = np.concatenate([arrays[f"WEIGHTS_{n}"] for n in sets], axis=1).astype(np.float64)
    if joints.min(initial=0) < 0 or joints.max(initial=0) >= len(matrices):
        problem = f"joint {joints.max()} is beyond the {len(matrices)} of the skin; repair the file"
        raise BokehguideError(f"{primitive.file}: {primitive.path}: {problem}")
    total = weights.sum(axis=1, keepdims=True)
    if not (np.isfinite(weights).all() and (total > 0.0).all()):
        raise BokehguideError(f"{primitive.file}: {primitive.path}: has weights that add up to 0 or are not finite; repair the file")
    result = np.zeros((len(joints), 4, 4))
    for joint, weight in zip(joints.T, (weights / total).T):
        result += weight[:, None, None] * matrices[joint]
    return result


def skinned(arrays: dict[str, np.ndarray], matrices: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays with positions, normals and tangents moved by a matrix `[V, 4, 4]` for each vertex.

    Normals go by the cofactors, which are the inverse transpose but for a factor.
    """
    linear, moved = matrices[:, :3, :3], dict(arrays)
    with np.errstate(over="ignore", invalid="ignore"):
        moved["POSITION"] = _each(linear, arrays["POSITION"]) + matrices[:, :3, 3].astype(np.float32)
        if "NORMAL" in arrays:
            x, y, z = np.moveaxis(linear, 2, 0)
            cofactors = np.stack((np.cross(y, z), np.cross(z, x), np.cross(x, y)), axis=2)
            moved["NORMAL"] = _each(cofactors, arrays["NORMAL"]) * np.sign(np.linalg.det(linear))[:, None].astype(np.float32)
        if "TANGENT" in arrays:
            moved["TANGENT"] = np.concatenate((_each(linear, arrays["TANGENT"][:, :3]), arrays["TANGENT"][:, 3:]), axis=1)
    return moved


def _each(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Each vector `[V, 3]` by its matrix `[V, 3, 3]`, float32."""
    return np.einsum("vij,vj->vi", matrices, vectors.astype(np.float64)).astype(np.float32)
