"""World matrices of nodes and of their instances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.accessors import read_floats
from bokehguide.scene.gltf.animations import Pose
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.parts import Part

INSTANCING = "EXT_mesh_gpu_instancing"
TRANSFORM = ("matrix", "rotation", "translation", "scale")
MAX_GROUPS = 32
"""Names above a node that are kept: a chain of a million nodes must not take a million names each."""


@dataclass(frozen=True)
class Placed:
    """A node, the matrix `[4, 4]` from its space to world space, and the names of the nodes above it, nearest first."""

    node: Part
    matrix: np.ndarray
    groups: tuple[str, ...] = ()


def place_nodes(document: Document, pose: Pose) -> list[Placed]:
    """All nodes of the default scene in the file's order, parents first.

    pose: replaces translations, rotations and scales. Raises BokehguideError for a node with two parents and for a cycle.
    """
    nodes = document.items("nodes")
    placed, seen = [], set()
    waiting = [(index, Placed(document.root, np.eye(4))) for index in reversed(_roots(document))]
    while waiting:
        index, parent = waiting.pop()
        node = nodes[index]
        if index in seen:
            problem = "has two parents or is its own ancestor; repair the file"
            raise BokehguideError(f"{document.file}: {node.path}: {problem}")
        seen.add(index)
        matrix, posed = parent.matrix, pose.of(node)
        if posed or any(key in node for key in TRANSFORM):
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = parent.matrix @ local_matrix(node, posed)
        placed.append(Placed(node, matrix, _names_above(parent)))
        if "children" in node:
            waiting += [(child, placed[-1]) for child in reversed(document.links(node, "children", "nodes"))]
    return placed


def _names_above(parent: Placed) -> tuple[str, ...]:
    """The names of a node and of the nodes above it, at most MAX_GROUPS."""
    named = (parent.node.label,) if "name" in parent.node else ()
    return (*named, *parent.groups)[:MAX_GROUPS]


def _roots(document: Document) -> list[int]:
    """The root nodes of the default scene, or of the file if it has no scenes."""
    scenes = document.items("scenes")
    if scenes:
        index = document.link(document.root, "scene", "scenes") or 0
        if len(scenes) > 1:
            document.note(f"scenes: only {scenes[index].label} of {len(scenes)} is drawn")
        return document.links(scenes[index], "nodes", "nodes")
    children = {child for node in document.items("nodes") for child in document.links(node, "children", "nodes")}
    return [index for index in range(len(document.items("nodes"))) if index not in children]


def local_matrix(node: Part, posed: Mapping[str, np.ndarray]) -> np.ndarray:
    """The matrix `[4, 4]` of a node relative to its parent, from `matrix` or translation, rotation and scale.

    posed: the values that replace those of the node, by key.
    """
    if "matrix" in node:
        return np.reshape(node.numbers("matrix", 16, ()), (4, 4)).T
    rotation = np.array(node.numbers("rotation", 4, (0.0, 0.0, 0.0, 1.0)))
    if not rotation.any():
        node.fail("rotation", "is not a rotation; give a quaternion of length 1")
    translation = np.array(node.numbers("translation", 3, (0.0, 0.0, 0.0)))
    scale = np.array(node.numbers("scale", 3, (1.0, 1.0, 1.0)))
    at_rest = {"translation": translation, "rotation": rotation, "scale": scale}
    return _matrices(*(posed.get(key, value)[None] for key, value in at_rest.items()))[0]


def instance_matrices(document: Document, placed: Placed, most: int) -> np.ndarray:
    """World matrices `[N, 4, 4]` of a node's instances (EXT_mesh_gpu_instancing), or its own matrix.

    Raises BokehguideError for more than `most` instances, and for attributes that do not agree.
    """
    if INSTANCING not in placed.node.extensions:
        return placed.matrix[None]
    attributes = placed.node.extension(INSTANCING).part("attributes")
    given = {}
    for name, kind in (("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3")):
        index = document.link(attributes, name, "accessors")
        if index is not None:
            given[name] = read_floats(document, index, kind).astype(np.float64)
    if len({len(values) for values in given.values()}) != 1:
        counts = ", ".join(f"{len(values)} of {name}" for name, values in given.items()) or "none"
        raise BokehguideError(f"{document.file}: {attributes.path}: counts must agree ({counts}); repair the file")
    count = len(next(iter(given.values())))
    if count > most:
        problem = f"makes more than {document.files.most_instances:,} instances in all; give fewer"
        raise BokehguideError(f"{document.file}: {attributes.path}: {problem}")
    rotation = given.get("ROTATION", np.tile((0.0, 0.0, 0.0, 1.0), (count, 1)))
    if not rotation.any(axis=1).all():
        problem = "holds a quaternion of length 0; repair the file"
        raise BokehguideError(f"{document.file}: {attributes.path}.ROTATION: {problem}")
    translation, scale = given.get("TRANSLATION", np.zeros((count, 3))), given.get("SCALE", np.ones((count, 3)))
    return placed.matrix @ _matrices(translation, rotation, scale)


def _matrices(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Matrices `[N, 4, 4]` of translations, quaternions xyzw and scales, `[N, 3 or 4]`."""
    x, y, z, w = np.moveaxis(rotation / np.linalg.norm(rotation, axis=1, keepdims=True), 1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrices = np.zeros((len(translation), 4, 4))
    matrices[:, :3, :3] = np.moveaxis(np.array(rows), 2, 0) * scale[:, None, :]
    matrices[:, :3, 3] = translation
    matrices[:, 3, 3] = 1.0
    return matrices
