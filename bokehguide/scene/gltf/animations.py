"""Animations: the values of animated properties at a time (glTF 2.0, section 3.11 and appendix C)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bokehguide.scene.gltf.accessors import as_floats, read_raw
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.parts import Part

KINDS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3", "weights": "SCALAR"}
"""Animated properties of nodes, and the types of their values."""
INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
POINTER = "KHR_animation_pointer"


@dataclass(frozen=True)
class Pose:
    """Animated properties of nodes at one time, float64 arrays by property, by the path of the node in the file."""

    values: Mapping[str, dict[str, np.ndarray]] = field(default_factory=dict)

    def of(self, node: Part) -> dict[str, np.ndarray]:
        """The animated properties of `node`, empty for a node at rest."""
        return self.values.get(node.path, {})


def read_pose(document: Document, time: float | None) -> Pose:
    """The pose at `time` in seconds; the pose at rest for None.

    Every animation of the file plays. If several animate one property of a node, the first of them counts. Before its first
    key and after its last key, a property keeps the value there. Raises BokehguideError for damaged animations.
    """
    values: dict[str, dict[str, np.ndarray]] = {}
    if time is None:
        return Pose()
    owners: dict[tuple[str, str], str] = {}
    for animation in document.items("animations"):
        samplers = animation.parts("samplers")
        for channel in animation.parts("channels"):
            target = channel.part("target")
            node = document.link(target, "node", "nodes")
            kind = target.text("path")
            if node is None or kind not in KINDS:
                what = POINTER if kind == "pointer" else "an unknown property"
                document.note(f"animations of {what}: left out", animation.label)
                continue
            part = document.items("nodes")[node]
            if "matrix" in part and kind != "weights":
                document.note("animations of nodes with a matrix: left out", part.label)
                continue
            if owners.setdefault((part.path, kind), animation.path) != animation.path:
                document.note("further animations of the same nodes: left out", animation.label)
                continue
            number = channel.whole("sampler", None)
            if number is None or number >= len(samplers):
                channel.fail("sampler", f"is no index into the {len(samplers)} samplers; repair the file")
            values.setdefault(part.path, {})[kind] = _sample(document, samplers[number], kind, time)
    return Pose(values)


def duration(document: Document, animation: Part) -> float | None:
    """Seconds until the last key by the bounds of the accessors, None where they have none."""
    last = []
    for sampler in animation.parts("samplers"):
        index = document.link(sampler, "input", "accessors")
        most: Any = None if index is None else document.items("accessors")[index].values.get("max")
        if isinstance(most, list) and len(most) == 1 and isinstance(most[0], (int, float)):
            last.append(float(most[0]))
    return max(last, default=None)


def _sample(document: Document, sampler: Part, kind: str, time: float) -> np.ndarray:
    """The value of a sampler at `time`, float64 `[width]`, or `[targets]` of weights."""
    times = read_raw(document, document.required(sampler, "input", "accessors"), "SCALAR")[:, 0]
    output = document.required(sampler, "output", "accessors")
    stored = read_raw(document, output, KINDS[kind])
    normalized = document.items("accessors")[output].flag("normalized")
    mode = sampler.text("interpolation") or "LINEAR"
    if mode not in INTERPOLATIONS:
        sampler.fail("interpolation", f"is none of {', '.join(INTERPOLATIONS)}; repair the file")
    parts = 3 if mode == "CUBICSPLINE" else 1
    targets = len(stored) // (parts * len(times)) if len(times) and kind == "weights" else 1
    if not len(times) or not targets or len(stored) != len(times) * parts * targets:
        sampler.fail("output", f"has {len(stored)} values for {len(times)} keys; repair the file")

    def key(number: int) -> np.ndarray:
        """The stored values of one key, `[parts, width]`."""
        rows = stored[number * parts * targets : (number + 1) * parts * targets]
        return as_floats(rows, normalized).astype(np.float64).reshape(parts, -1)

    before = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 1))
    start, middle = key(before), parts // 2
    value = start[middle]
    if mode != "STEP" and before + 1 < len(times) and time > times[before]:
        step = float(times[before + 1]) - float(times[before])
        at = (time - float(times[before])) / step
        end = key(before + 1)
        if mode == "CUBICSPLINE":
            value = _hermite(at, step, start, end)
        else:
            value = _slerp(at, value, end[0]) if kind == "rotation" else (1.0 - at) * value + at * end[0]
    if not np.isfinite(value).all() or (kind == "rotation" and not value.any()):
        sampler.fail("output", f"is no {kind} at {time:g} s; repair the file")
    return value


def _hermite(at: float, step: float, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The cubic spline between two keys, at a fraction of the `step` in seconds.

    Each key has its in-tangent, value and out-tangent.
    """
    square, cube = at * at, at * at * at
    rise = 3.0 * square - 2.0 * cube
    tangents = (cube - 2.0 * square + at) * start[2] + (cube - square) * end[0]
    return (1.0 - rise) * start[1] + rise * end[1] + step * tangents


def _slerp(at: float, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Spherical interpolation of two quaternions along the shorter arc."""
    start, end = (each / max(np.linalg.norm(each), 1e-30) for each in (start, end))
    cosine = float(start @ end)
    if cosine < 0.0:
        end, cosine = -end, -cosine
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-6:
        return (1.0 - at) * start + at * end
    return (np.sin((1.0 - at) * angle) * start + np.sin(at * angle) * end) / np.sin(angle)
