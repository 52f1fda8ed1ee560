"""Catmull-Clark subdivision surfaces, refined a few times.

The rules are those of Catmull and Clark (Recursively generated B-spline surfaces on arbitrary topological meshes, Computer-Aided
Design 10, 1978), with boundaries and creases by DeRose, Kass and Truong (Subdivision surfaces in character animation, SIGGRAPH
1998). A fractional sharpness mixes the rules of a sharp and of a smooth edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags, identity, vstack
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class Cage:
    """A polygon mesh whose vertices are weighted sums of those of the control mesh.

    counts: corners of each polygon, `[F]`. indices: the vertex of each corner, `[I]`. edges, sharpness: sorted vertices `[E, 2]`
    of creased edges, and their sharpness `[E]`. corners: sharpness of vertices, `[V]`. weights: `[V, V0]`.
    """

    counts: np.ndarray
    indices: np.ndarray
    edges: np.ndarray
    sharpness: np.ndarray
    corners: np.ndarray
    weights: csr_matrix

    @property
    def faces(self) -> np.ndarray:
        """The polygon of each corner, `[I]`."""
        return np.repeat(np.arange(len(self.counts)), self.counts)


@dataclass(frozen=True)
class _Edges:
    """The edges of a mesh, as sorted vertices `[E, 2]`; the edge from each corner to the next one, and to the one before, `[I]`;
    and the number of polygons at each edge, `[E]`."""

    ends: np.ndarray
    after: np.ndarray
    before: np.ndarray
    uses: np.ndarray


def refined(cage: Cage) -> Cage:
    """The quads around the corners of a mesh.

    Corner number i becomes quad number i: the corner, the middle of the edge to the next corner, the middle of the polygon, and
    that of the edge before.
    """
    vertices, faces, edges = len(cage.corners), cage.faces, _edges(cage)
    sharpness = _sharpness(cage, edges)
    rows = [_vertex_points(cage, edges, sharpness), _edge_points(cage, edges, sharpness), _face_points(cage)]
    middle = vertices + len(edges.ends) + faces
    quads = np.stack([cage.indices, vertices + edges.after, middle, vertices + edges.before], axis=1)
    halves = np.stack([edges.ends, vertices + np.repeat(np.arange(len(edges.ends))[:, None], 2, axis=1)], axis=2).reshape(-1, 2)
    left = np.repeat(np.where(edges.uses == 2, np.maximum(sharpness - 1.0, 0.0), 0.0), 2)
    corners = np.zeros(vertices + len(edges.ends) + len(cage.counts))
    corners[:vertices] = np.maximum(cage.corners - 1.0, 0.0)
    corners[:vertices][np.isinf(cage.corners)] = np.inf
    return Cage(
        counts=np.full(len(quads), 4),
        indices=quads.ravel(),
        edges=halves[left > 0.0],
        sharpness=left[left > 0.0],
        corners=corners,
        weights=csr_matrix(vstack(rows) @ cage.weights),
    )


def control_cage(counts: np.ndarray, indices: np.ndarray, vertices: int) -> Cage:
    """A mesh without creases, as its own control mesh. Vertices of a single polygon are corners."""
    polygons = np.bincount(indices, minlength=vertices)
    none = np.zeros((0, 2), np.int64)
    corners = np.where(polygons == 1, np.inf, 0.0)
    return Cage(counts, indices, none, np.zeros(0), corners, csr_matrix(identity(vertices)))


def refined_corners(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Values `[I, C]` of corners, interpolated linearly on the quads of `refined`, `[4 I, C]`."""
    following, previous = _neighbours(counts)
    faces = np.repeat(np.arange(len(counts)), counts)
    sums = np.zeros((len(counts), values.shape[1]))
    np.add.at(sums, faces, values)
    middles = (sums / np.maximum(counts, 1)[:, None])[faces]
    quads = [values, 0.5 * (values + values[following]), middles, 0.5 * (values + values[previous])]
    return np.stack(quads, axis=1).reshape(-1, values.shape[1]).astype(np.float32)


def smooth_normals(points: np.ndarray, cage: Cage) -> np.ndarray:
    """Normals `[I, 3]` of corners, area-weighted over the polygons that smooth edges join around a vertex."""
    edges = _edges(cage)
    sharpness = _sharpness(cage, edges)
    following, _ = _neighbours(cage.counts)
    first = np.argsort(edges.after, kind="stable")
    starts = np.cumsum(edges.uses) - edges.uses
    joined = np.flatnonzero((edges.uses == 2) & (sharpness < 1.0))
    a, b = first[starts[joined]], first[starts[joined] + 1]  # the two corners from which a joined edge starts
    opposed = cage.indices[a] != cage.indices[b]
    links = np.concatenate(
        [np.stack([a, np.where(opposed, following[b], b)]), np.stack([following[a], np.where(opposed, b, following[b])])], axis=1
    )
    count = len(cage.indices)
    _, groups = connected_components(coo_matrix((np.ones(links.shape[1]), links), shape=(count, count)), directed=False)
    corners = points[cage.indices].astype(np.float64)
    _, previous = _neighbours(cage.counts)
    normals = np.cross(corners[following] - corners, corners[previous] - corners)
    sums = np.zeros((groups.max(initial=-1) + 1, 3))
    np.add.at(sums, groups, normals)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return (sums / np.where(lengths > 0.0, lengths, 1.0))[groups].astype(np.float32)


def _neighbours(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners after and before each corner of its polygon, `[I]`."""
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    sizes, place = np.repeat(counts, counts), np.arange(counts.sum())
    return starts + (place - starts + 1) % sizes, starts + (place - starts - 1) % sizes


def _edges(cage: Cage) -> _Edges:
    """The edges of a mesh, each once."""
    following, previous = _neighbours(cage.counts)
    pairs = np.sort(np.stack([cage.indices, cage.indices[following]], axis=1), axis=1)
    ends, after = np.unique(pairs, axis=0, return_inverse=True)
    after = after.ravel()
    return _Edges(ends, after, after[previous], np.bincount(after, minlength=len(ends)))


def _sharpness(cage: Cage, edges: _Edges) -> np.ndarray:
    """The sharpness of each edge, infinite at boundaries and where more than two polygons meet."""
    size = max(len(cage.corners), 1)
    known, wanted = cage.edges @ (size, 1), edges.ends @ (size, 1)
    order = np.argsort(known, kind="stable")
    place = np.searchsorted(known[order], wanted).clip(0, max(len(known) - 1, 0))
    sharpness = np.zeros(len(edges.ends))
    if len(known):
        found = known[order][place] == wanted
        sharpness[found] = cage.sharpness[order][place[found]]
    return np.where(edges.uses == 2, sharpness, np.inf)


def _face_points(cage: Cage) -> csr_matrix:
    """The middles of polygons, `[F, V]`."""
    shape = len(cage.counts), len(cage.corners)
    weights = np.repeat(1.0 / np.maximum(cage.counts, 1), cage.counts)
    return csr_matrix(coo_matrix((weights, (cage.faces, cage.indices)), shape=shape))


def _middles(cage: Cage, edges: _Edges) -> csr_matrix:
    """The middles of edges, `[E, V]`."""
    rows = np.repeat(np.arange(len(edges.ends)), 2)
    shape = len(edges.ends), len(cage.corners)
    return csr_matrix(coo_matrix((np.full(len(rows), 0.5), (rows, edges.ends.ravel())), shape=shape))


def _edge_points(cage: Cage, edges: _Edges, sharpness: np.ndarray) -> csr_matrix:
    """The new vertices of edges, `[E, V]`."""
    middles, sharp = _middles(cage, edges), sharpness.clip(0.0, 1.0)
    beside = coo_matrix((np.ones(len(edges.after)), (edges.after, cage.faces)), shape=(len(edges.ends), len(cage.counts)))
    smooth = 0.5 * middles + 0.25 * (beside @ _face_points(cage))
    return csr_matrix(diags(sharp) @ middles + diags(1.0 - sharp) @ smooth)


def _vertex_points(cage: Cage, edges: _Edges, sharpness: np.ndarray) -> csr_matrix:
    """The new places of vertices, `[V, V]`."""
    count, middles = len(cage.corners), _middles(cage, edges)
    ends, of_edge = edges.ends.ravel(), np.repeat(np.arange(len(edges.ends)), 2)
    valence = np.bincount(ends, minlength=count)
    around = coo_matrix((np.ones(len(cage.indices)), (cage.indices, cage.faces)), shape=(count, len(cage.counts)))
    touching = coo_matrix((np.ones(len(ends)), (ends, of_edge)), shape=(count, len(edges.ends)))
    n = np.maximum(valence, 1).astype(np.float64)
    polygons = np.maximum(np.bincount(cage.indices, minlength=count), 1)
    smooth = diags(1.0 / (n * polygons)) @ around @ _face_points(cage) + diags(2.0 / n**2) @ touching @ middles
    smooth = smooth + diags((n - 3.0) / n)
    is_sharp = sharpness > 0.0
    sharp_edges = np.bincount(ends[is_sharp[of_edge]], minlength=count)
    creased = coo_matrix((is_sharp[of_edge] * 1.0, (ends, of_edge)), shape=(count, len(edges.ends)))
    crease = 0.5 * identity(count) + 0.25 * (creased @ middles)
    strength = np.zeros(count)
    np.add.at(strength, ends[is_sharp[of_edge]], sharpness[of_edge][is_sharp[of_edge]].clip(0.0, 1.0))
    strength = (strength / np.maximum(sharp_edges, 1)).clip(0.0, 1.0)
    fixed = (sharp_edges > 2) | (valence == 0)
    on_crease = np.where(sharp_edges == 2, strength, 0.0)
    kept = np.maximum(np.where(sharp_edges > 2, strength, fixed * 1.0), cage.corners.clip(0.0, 1.0))
    mixed = diags(1.0 - on_crease) @ smooth + diags(on_crease) @ crease
    return csr_matrix(diags(kept) + diags(1.0 - kept) @ mixed)
