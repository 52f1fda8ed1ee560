"""Catmull-Clark subdivision surfaces, refined a few times.

The rules are those of Catmull and Clark (Recursively generated B-spline surfaces on arbitrary topological meshes, Computer-Aided
Design 10, 1978), with boundaries and creases by DeRose, Kass and Truong (Subdivision surfaces in character animation, SIGGRAPH
1998). A fractional sharpness mixes the rules of a sharp and of a smooth edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Cage:
    """A polygon mesh.

    counts: corners of each polygon, `[F]`. indices: the vertex of each corner, `[I]`. edges, sharpness: sorted vertices `[E, 2]`
    of creased edges, and their sharpness `[E]`. corners: sharpness of vertices, `[V]`.
    """

    counts: np.ndarray
    indices: np.ndarray
    edges: np.ndarray
    sharpness: np.ndarray
    corners: np.ndarray

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


@dataclass(frozen=True)
class Refinement:
    """The quads around the corners of a mesh.

    Corner number i becomes quad number i: the corner, the middle of the edge to the next corner, the middle of the polygon, and
    that of the edge before. cage: the mesh. edges, sharpness: its edges, and the sharpness of each, `[E]`.
    """

    cage: Cage
    edges: _Edges
    sharpness: np.ndarray

    def refined(self) -> Cage:
        """The quads as a mesh."""
        cage, edges, vertices = self.cage, self.edges, len(self.cage.corners)
        middle = vertices + len(edges.ends) + cage.faces
        quads = np.stack([cage.indices, vertices + edges.after, middle, vertices + edges.before], axis=1)
        halves = np.stack([edges.ends, vertices + np.repeat(np.arange(len(edges.ends))[:, None], 2, axis=1)], axis=2)
        left = np.repeat(np.where(edges.uses == 2, np.maximum(self.sharpness - 1.0, 0.0), 0.0), 2)
        corners = np.zeros(vertices + len(edges.ends) + len(cage.counts))
        corners[:vertices] = np.maximum(cage.corners - 1.0, 0.0)
        return Cage(np.full(len(quads), 4), quads.ravel(), halves.reshape(-1, 2)[left > 0.0], left[left > 0.0], corners)

    def at_vertices(self, values: np.ndarray) -> np.ndarray:
        """Values `[V, C]` of vertices, at the vertices of the quads."""
        values = values.astype(np.float64)
        middles = 0.5 * (values[self.edges.ends[:, 0]] + values[self.edges.ends[:, 1]])
        faces = _sums(values[self.cage.indices], self.cage.faces, len(self.cage.counts)) / self.cage.counts[:, None]
        return np.concatenate([self._vertex_points(values, middles, faces), self._edge_points(middles, faces), faces])

    def at_corners(self, values: np.ndarray) -> np.ndarray:
        """Values `[I, C]` of corners, interpolated linearly on the quads, `[4 I, C]`."""
        following, previous = _neighbours(self.cage.counts)
        faces = self.cage.faces
        middles = (_sums(values, faces, len(self.cage.counts)) / self.cage.counts[:, None])[faces]
        quads = [values, 0.5 * (values + values[following]), middles, 0.5 * (values + values[previous])]
        return np.stack(quads, axis=1).reshape(-1, values.shape[1]).astype(np.float32)

    def _edge_points(self, middles: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """The new vertices of edges, `[E, C]`. middles, faces: those of edges and polygons."""
        beside = _sums(faces[self.cage.faces], self.edges.after, len(middles))
        sharp = self.sharpness.clip(0.0, 1.0)[:, None]
        return sharp * middles + (1.0 - sharp) * (0.5 * middles + 0.25 * beside)

    def _vertex_points(self, values: np.ndarray, middles: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """The new places of vertices, `[V, C]`. middles, faces: those of edges and polygons."""
        cage, ends, count = self.cage, self.edges.ends.ravel(), len(values)
        of_edge = np.repeat(np.arange(len(middles)), 2)
        valence = np.bincount(ends, minlength=count)
        n = np.maximum(valence, 1.0)[:, None]
        polygons = np.maximum(np.bincount(cage.indices, minlength=count), 1)[:, None]
        smooth = _sums(faces[cage.faces], cage.indices, count) / (n * polygons) + (n - 3.0) / n * values
        smooth += 2.0 / n**2 * _sums(middles[of_edge], ends, count)
        of_sharp = of_edge[self.sharpness[of_edge] > 0.0]
        sharp_ends = ends[self.sharpness[of_edge] > 0.0]
        sharp_edges = np.bincount(sharp_ends, minlength=count)
        crease = 0.5 * values + 0.25 * _sums(middles[of_sharp], sharp_ends, count)
        strength = np.bincount(sharp_ends, self.sharpness[of_sharp].clip(0.0, 1.0), count) / np.maximum(sharp_edges, 1)
        fixed = np.where(sharp_edges > 2, strength, (valence == 0) * 1.0)
        kept = np.maximum(fixed, cage.corners.clip(0.0, 1.0))[:, None]
        on_crease = np.where(sharp_edges == 2, strength, 0.0)[:, None]
        return kept * values + (1.0 - kept) * ((1.0 - on_crease) * smooth + on_crease * crease)


def refinement(cage: Cage) -> Refinement:
    """The refinement of a mesh whose polygons have three corners or more."""
    edges = _edges(cage)
    return Refinement(cage, edges, _sharpness(cage, edges))


def control_cage(counts: np.ndarray, indices: np.ndarray, vertices: int) -> Cage:
    """A mesh without creases. Vertices of a single polygon are corners."""
    polygons = np.bincount(indices, minlength=vertices)
    corners = np.where(polygons == 1, np.inf, 0.0)
    return Cage(counts, indices, np.zeros((0, 2), np.int64), np.zeros(0), corners)


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
    groups = _joined(links, count)
    corners = points[cage.indices].astype(np.float64)
    _, previous = _neighbours(cage.counts)
    normals = np.cross(corners[following] - corners, corners[previous] - corners)
    sums = _sums(normals, groups, count)
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
    first, second = np.sort([cage.indices, cage.indices[following]], axis=0)
    keys, after = np.unique(first * len(cage.corners) + second, return_inverse=True)
    ends = np.stack(np.divmod(keys, max(len(cage.corners), 1)), axis=1)
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


def _sums(values: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    """The sums `[count, C]` of the values `[N, C]` of each group."""
    sums = [np.bincount(groups, column, count) for column in values.T]
    return np.stack(sums, axis=1) if sums else np.zeros((count, 0))


def _joined(links: np.ndarray, count: int) -> np.ndarray:
    """The least member of the group of each of `count` things, `[count]`. links: two members of a group each, `[2, L]`."""
    a, b = links
    least = np.arange(count)
    while (least[a] != least[b]).any():
        lower = np.minimum(least[a], least[b])
        np.minimum.at(least, least[a], lower)
        np.minimum.at(least, least[b], lower)
        while (least != least[least]).any():
            least = least[least]
    return least
