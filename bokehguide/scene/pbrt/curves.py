"""Curves of pbrt as tubes and ribbons: the many curves of hair, grass or cloth become one mesh for each material."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bokehguide.scene.pbrt.contents import Shape
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.shapes import joined
from bokehguide.scene.tables import did_you_mean
from bokehguide.scene.types import Mesh

DETAIL = ((3_000, 8, 6), (100_000, 4, 4), (math.inf, 3, 3))
"""Segments of a scene's curves up to which each has so many steps along its length, and so many sides."""
KINDS = ("flat", "cylinder", "ribbon")
BASES = ("bezier", "bspline")
TO_BEZIER = {
    ("bezier", 2): np.array([(3, 0, 0), (1, 2, 0), (0, 2, 1), (0, 0, 3)]) / 3.0,
    ("bezier", 3): np.eye(4),
    ("bspline", 2): np.array([(3, 3, 0), (1, 5, 0), (0, 5, 1), (0, 3, 3)]) / 6.0,
    ("bspline", 3): np.array([(1, 4, 1, 0), (0, 4, 2, 0), (0, 2, 4, 0), (0, 1, 4, 1)]) / 6.0,
}
"""Control points of a cubic Bézier segment from those of a segment of a basis and a degree."""


@dataclass(frozen=True)
class Curve:
    """A curve. points: control points of its cubic Bézier segments `[S, 4, 3]`. widths: at both ends. normals: of a ribbon
    `[S + 1, 3]`, None for a tube."""

    points: np.ndarray
    widths: tuple[float, float]
    normals: np.ndarray | None


def segment_count(parameters: Parameters) -> int:
    """Segments of a curve. Raises BokehguideError for a number of control points that its basis does not permit."""
    points, degree, basis = parameters.numbers("P", 3), int(parameters.number("degree", 3)), parameters.text("basis", "bezier")
    if points is None:
        parameters.place.fail('curve without control points; give "point3 P"')
    if degree not in (2, 3):
        parameters.fail("degree", "is no degree of a curve; give 2 or 3")
    if basis not in BASES:
        parameters.fail("basis", f"is unknown; {did_you_mean(basis, BASES)}")
    spare = len(points) - 1 - degree
    if spare < 0 or (basis == "bezier" and spare % degree):
        more = f" and multiples of {degree} more" if basis == "bezier" else " or more"
        parameters.fail("P", f"has {len(points)} points; a {basis} of degree {degree} needs {degree + 1}{more}")
    return 1 + (spare // degree if basis == "bezier" else spare)


def read_curve(parameters: Parameters) -> Curve:
    """A curve in its own space. Raises BokehguideError for values out of range."""
    count, degree, basis = segment_count(parameters), int(parameters.number("degree", 3)), parameters.text("basis", "bezier")
    kind, width = parameters.text("type", "flat"), parameters.number("width", 1.0)
    if kind not in KINDS:
        parameters.fail("type", f"is unknown; {did_you_mean(kind, KINDS)}")
    points, normals = parameters.numbers("P", 3), parameters.numbers("N", 3) if kind == "ribbon" else None
    assert points is not None
    if kind == "ribbon" and (normals is None or len(normals) != count + 1):
        parameters.place.fail(f'curve: a ribbon of {count} segments needs {count + 1} normals; give "normal N"')
    first = np.arange(count) * (degree if basis == "bezier" else 1)
    segments = TO_BEZIER[basis, degree] @ points[first[:, None] + np.arange(degree + 1)]
    ends = parameters.number("width0", width), parameters.number("width1", width)
    return Curve(segments, (max(ends[0], 0.0), max(ends[1], 0.0)), normals)


def detail(segments: int) -> tuple[int, int]:
    """Steps of each segment and sides of each tube in a scene of curves with `segments` in all."""
    return next((steps, sides) for most, steps, sides in DETAIL if segments <= most)


def triangle_count(segments: int, steps: int, sides: int) -> int:
    """Triangles of tubes with `segments` in all."""
    return 2 * segments * steps * sides


def curves_mesh(shapes: Iterable[Shape], steps: int, sides: int) -> Mesh:
    """Curves of one material as one mesh, under the matrix of each shape. steps: of each segment. sides: of each tube.

    Raises BokehguideError for values out of range.
    """
    alike: dict[tuple[int, bool], list[tuple[Curve, np.ndarray]]] = {}
    for shape in shapes:
        curve = read_curve(shape.parameters)
        alike.setdefault((len(curve.points), curve.normals is None), []).append((curve, shape.matrix))
    return joined([_swept(each, steps, sides) for each in alike.values()])


def _swept(curves: Sequence[tuple[Curve, np.ndarray]], steps: int, sides: int) -> Mesh:
    """Curves with their matrices, all tubes or all ribbons of one number of segments, as one mesh. A matrix scales the width by
    the cube root of its determinant."""
    matrices = np.stack([matrix for _, matrix in curves])
    linear, offset = matrices[:, :3, :3], matrices[:, None, None, :3, 3]
    points = np.stack([curve.points for curve, _ in curves]) @ linear.transpose(0, 2, 1)[:, None] + offset
    scale = np.abs(np.linalg.det(linear)) ** (1.0 / 3.0)
    t = np.arange(steps) / steps
    weights = np.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1)
    path = (weights @ points).reshape(len(points), -1, 3)
    path = np.concatenate([path, points[:, -1, -1:]], axis=1)
    share = np.linspace(0.0, 1.0, path.shape[1])
    ends = np.array([curve.widths for curve, _ in curves]) * scale[:, None]
    radii = 0.5 * (ends[:, :1] * (1.0 - share) + ends[:, 1:] * share)
    along = _unit(np.gradient(path, axis=1))
    if curves[0][0].normals is None:
        return _tubes(path, along, radii, sides)
    given = np.stack([curve.normals for curve, _ in curves if curve.normals is not None]) @ np.linalg.inv(linear)
    knots = np.linspace(0.0, given.shape[1] - 1.0, path.shape[1])
    low = np.minimum(knots.astype(int), given.shape[1] - 2)
    facing = given[:, low] + (knots - low)[:, None] * (given[:, low + 1] - given[:, low])
    return _ribbons(path, _unit(np.cross(along, facing)), _unit(facing), radii)


def _tubes(path: np.ndarray, along: np.ndarray, radii: np.ndarray, sides: int) -> Mesh:
    """Tubes around paths `[C, K, 3]` with tangents `along` and `radii` `[C, K]`; their mean width is that of a round tube."""
    across = np.empty_like(path)
    axis = np.eye(3)[np.abs(along[:, 0]).argmin(axis=1)]
    for step in range(path.shape[1]):  # the frame turns as little as possible along the path
        axis = _unit(axis - (axis * along[:, step]).sum(axis=1, keepdims=True) * along[:, step])
        across[:, step] = axis
    angles = 2.0 * math.pi * np.arange(sides + 1) / sides
    other = np.cross(along, across)
    rings = np.cos(angles)[:, None] * across[:, :, None] + np.sin(angles)[:, None] * other[:, :, None]
    wide = radii * (math.pi / sides) / math.sin(math.pi / sides)
    return _grid(path[:, :, None] + wide[..., None, None] * rings, rings, 0.5 + 0.5 * np.cos(angles))


def _ribbons(path: np.ndarray, across: np.ndarray, facing: np.ndarray, radii: np.ndarray) -> Mesh:
    """Flat strips along paths `[C, K, 3]` that are wide along `across` and face `facing`."""
    sides = np.array([-1.0, 1.0])[:, None]
    points = path[:, :, None] + radii[..., None, None] * sides * across[:, :, None]
    return _grid(points, np.repeat(facing[:, :, None], 2, axis=2), np.array([0.0, 1.0]))


def _grid(points: np.ndarray, normals: np.ndarray, v: np.ndarray) -> Mesh:
    """The quadrilaterals between neighbours of `points` `[C, K, R, 3]` as triangles. u runs along the curve. v: across `[R]`."""
    count, rows, columns, _ = points.shape
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    up = first + columns
    patch = np.concatenate([np.stack([first, first + 1, up + 1], 1), np.stack([first, up + 1, up], 1)])
    triangles = patch + rows * columns * np.arange(count)[:, None, None]
    uvs = np.stack(np.broadcast_arrays(np.linspace(0.0, 1.0, rows)[:, None], 1.0 - v), axis=-1)
    return Mesh(
        points.reshape(-1, 3).astype(np.float32),
        triangles.reshape(-1, 3).astype(np.int32),
        0,
        normals.reshape(-1, 3).astype(np.float32),
        np.tile(uvs.reshape(-1, 1, 2), (count, 1, 1)).astype(np.float32),
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors `[..., 3]`. Zero vectors stay zero."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 0.0, lengths, 1.0)
