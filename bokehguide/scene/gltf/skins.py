"""Skins: vertices that follow the joints of a skeleton, in the pose of the file.

A vertex moves to Σ w J B v, with the world matrix J of a joint and its inverse bind matrix B
(glTF 2.0 section 3.7.3.3). The matrix of the mesh's node has no effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.accessors import read_floats
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.nodes import Placed
from bokehguide.scene.gltf.parts import Part

INFLUENCES = 8
"""Maximum number of joint sets; each has four joints."""
SKINNING = {f"{name}_{number}": ("VEC4",) for name in ("JOINTS", "WEIGHTS") for number in range(INFLUENCES)}
"""The attributes with the joints and weights of vertices, and their types."""


class Skins:
    """The joint matrices of the skins of a file, each computed once. placed: the nodes of the scene."""

    def __init__(self, document: Document, placed: Sequence[Placed]):
        self._document = document
        self._world = {one.node.path: one.matrix for one in placed}
        self._matrices: dict[int, np.ndarray] = {}

    def joint_matrices(self, index: int) -> np.ndarray:
        """The matrices J B `[joints, 4, 4]` of a skin. Raises as `joint_matrices`."""
        if index not in self._matrices:
            self._matrices[index] = joint_matrices(self._document, index, self._world)
        return self._matrices[index]


def joint_matrices(document: Document, index: int, world: Mapping[str, np.ndarray]) -> np.ndarray:
    """The matrices J B `[joints, 4, 4]` of a skin. world: matrices of the scene's nodes by their paths.

    Raises BokehguideError for joints outside the scene and for missing inverse bind matrices.
    """
    skin = document.items("skins")[index]
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
    """The weighted mean of the joint matrices for each vertex, float64 `[V, 4, 4]`; None without joints and weights.

    Raises BokehguideError for joints outside the skin and for invalid weights.
    """
    sets = [n for n in range(INFLUENCES) if f"JOINTS_{n}" in arrays and f"WEIGHTS_{n}" in arrays]
    if not sets:
        return None
    joints = np.concatenate([arrays[f"JOINTS_{n}"] for n in sets], axis=1).astype(np.int64)
    weights = np.concatenate([arrays[f"WEIGHTS_{n}"] for n in sets], axis=1).astype(np.float64)
    if joints.min(initial=0) < 0 or joints.max(initial=0) >= len(matrices):
        problem = f"joint {joints.max()} is not below {len(matrices)}, the number of joints; repair the file"
        raise BokehguideError(f"{primitive.file}: {primitive.path}: {problem}")
    total = weights.sum(axis=1, keepdims=True)
    if not (np.isfinite(weights).all() and (total > 0.0).all()):
        raise BokehguideError(
            f"{primitive.file}: {primitive.path}: has weights that add up to 0 or are not finite; repair the file"
        )
    result = np.zeros((len(joints), 4, 4))
    for joint, weight in zip(joints.T, (weights / total).T):
        result += weight[:, None, None] * matrices[joint]
    return result


def skinned(arrays: dict[str, np.ndarray], matrices: np.ndarray) -> dict[str, np.ndarray]:
    """`arrays` with positions, normals and tangents under one matrix for each vertex, `[V, 4, 4]`.

    Normals transform with the cofactors, which are proportional to the inverse transpose.
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
    """The products of matrices `[V, 3, 3]` and vectors `[V, 3]`, float32."""
    return np.einsum("vij,vj->vi", matrices, vectors.astype(np.float64)).astype(np.float32)
