"""Morph targets: differences of vertex attributes, each with a weight (glTF 2.0, section 3.7.2.2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.accessors import as_floats, read_raw
from bokehguide.scene.gltf.animations import Pose
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.parts import Part

KINDS = {"POSITION": ("VEC3",), "NORMAL": ("VEC3",), "TANGENT": ("VEC3",), "COLOR_0": ("VEC3", "VEC4")}
"""Attributes that targets change, with the types of the differences; texture coordinates are VEC2."""


def morph_weights(node: Part, mesh: Part, pose: Pose) -> tuple[float, ...]:
    """The weights of the morph targets of `mesh` at `node`: those of the pose, of the node, or of the mesh.

    Raises BokehguideError for weights that are not finite.
    """
    posed = pose.of(node).get("weights")
    if posed is not None:
        return tuple(map(float, posed))
    part = node if "weights" in node else mesh
    stored = part.values.get("weights", [])
    return part.numbers("weights", len(stored) if isinstance(stored, list) else 0, ())


def morph(
    document: Document,
    primitive: Part,
    arrays: dict[str, np.ndarray],
    weights: Sequence[float],
    used: np.ndarray | slice,
    name: str,
) -> None:
    """Add the weighted differences of the targets to `arrays`, float32 `[V, width]` by attribute.

    used: indices `[V]` of the vertices of `arrays` among the stored ones. name: the mesh's, for notes. Raises BokehguideError
    for differences whose number is wrong.
    """
    targets = primitive.parts("targets")
    if targets and weights and len(targets) != len(weights):
        document.note(f"morph targets: {len(weights)} weights for {len(targets)} targets", name)
    total: dict[tuple[str, int], float] = {}
    for target, weight in zip(targets, weights):
        for key in target.values if weight else ():
            accessor = document.required(target, key, "accessors")
            total[key, accessor] = total.get((key, accessor), 0.0) + weight
    for (key, accessor), weight in total.items():
        if key in arrays:
            stored = read_raw(document, accessor, *KINDS.get(key, ("VEC2",)))
            arrays[key] = _moved(document, primitive, arrays[key], stored, accessor, weight, used)


def _moved(
    document: Document,
    primitive: Part,
    array: np.ndarray,
    stored: np.ndarray,
    accessor: int,
    weight: float,
    used: np.ndarray | slice,
) -> np.ndarray:
    """`array` `[V, width]` with the differences of one accessor, which may have fewer columns."""
    part = document.items("accessors")[accessor]
    count = len(array) if isinstance(used, slice) else int(used.max(initial=-1)) + 1
    if len(stored) < count:
        place = f"{document.file}: {primitive.path}.targets"
        raise BokehguideError(f"{place}: {len(stored)} differences in {part.path} for {count} vertices; repair the file")
    moved = array.copy()
    width = min(stored.shape[1], array.shape[1])
    with np.errstate(over="ignore", invalid="ignore"):
        moved[:, :width] += np.float32(weight) * as_floats(stored[used], part.flag("normalized"))[: len(array), :width]
    return moved
