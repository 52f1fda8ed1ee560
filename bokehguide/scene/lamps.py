"""Lamps of a scene, and which share of the lens one of them covers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.scene.types import Camera, Mesh, Scene, Sun

PEAK = 10.0
"""A texel is a lamp where its luminance is above this multiple of the map's mean."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class Lamps:
    """N lamps as discs: centres `[N, 3]` and radii `[N]` in metres, those of discs of the same area.

    Lamps of an environment lie at infinity: their centres are unit directions and
    their radii the tangents of the angular radii; `infinite` `[N]` says which. extents: radii
    of the spheres about the centres that hold all of each lamp. outlines: `[N, 3, 3]`, of ellipsoids of the lamps'
    proportions that do: sums of the squares of their half axes, 0 at infinity. luminance: of their radiance, `[N]`;
    textures are not looked at. panels: half edges `[N, 2, 3]` of those that are parallelograms of two triangles, 0 of the
    others. triangles: which lamp each of the scene's triangles belongs to, -1 for none, int32 `[T]`. texels: which lamp
    each texel of the map belongs to, -1 for none, `[H, W]`; None where there is no map.
    """

    centres: np.ndarray
    radii: np.ndarray
    extents: np.ndarray
    outlines: np.ndarray
    luminance: np.ndarray
    panels: np.ndarray
    infinite: np.ndarray
    triangles: np.ndarray
    texels: np.ndarray | None


def find_lamps(scene: Scene) -> Lamps:
    """All emissive components of the geometry, all bright peaks of the environment, and all suns."""
    parts, pieces, near = [], [], 0
    for mesh in scene.meshes:
        piece, material = np.full(len(mesh.triangles), -1, np.int32), scene.materials[mesh.material]
        if material.emits:
            piece = _pieces(mesh)
            parts.append(_components(mesh, piece, LUMINANCE @ material.emission))
            piece = piece + np.int32(near)
            near += len(parts[-1][0])
        pieces.append(piece)
    texels = None
    if scene.environment is not None:
        texels, peaks = _peaks(scene.environment.radiance, scene.environment.rotation)
        texels = np.where(texels >= 0, texels + near, -1)
        parts.append(peaks)
    parts += [_disc(sun) for sun in scene.suns]
    parts.append(_at_infinity(*np.zeros((2, 0)), np.zeros((0, 3)), np.zeros(0)))
    centres, *columns = (np.concatenate(arrays) for arrays in zip(*parts))
    triangles = np.concatenate(pieces) if pieces else np.zeros(0, np.int32)
    return Lamps(centres, *columns, infinite=np.arange(len(centres)) >= near, triangles=triangles, texels=texels)


def lens_coverage(scene: Scene, lamps: Lamps | None = None) -> float | None:
    """Median share of the lens disc that one lamp covers, or None without a lamp in sight.

    A pixel whose focus point lies at distance d on the axis sees a lamp of radius R
    at depth Z projected through that point onto the lens, at |d / (d - Z)| of its
    size. Lamps count whose circle of confusion touches the frame. lamps: those of the
    scene, where they have been found already.
    """
    camera = scene.camera
    if camera.aperture_radius == 0.0:
        return None
    lamps = find_lamps(scene) if lamps is None else lamps
    x, y, depth = _camera_space(camera, lamps)
    focus_distance = min(camera.focus_distance, FARTHEST_FOCUS)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Of a lamp at infinity the radius is a tangent, and R d / (Z - d) tends to d tan.
        gap = np.where(lamps.infinite, depth, np.abs(depth - focus_distance))
        share = (lamps.radii * focus_distance / gap / camera.aperture_radius) ** 2
        seen = depth > 0.0
        seen &= _touches_frame(x / depth, y / depth, np.where(lamps.infinite, np.inf, depth), scene)
    if scene.environment is not None and not scene.environment.visible:
        seen &= ~lamps.infinite
    return float(np.median(np.minimum(share[seen], 1.0))) if seen.any() else None


def _touches_frame(x: np.ndarray, y: np.ndarray, depth: np.ndarray, scene: Scene) -> np.ndarray:
    """Whether the circles of confusion of points at slopes x, y and `depth` reach the frame."""
    camera, film = scene.camera, scene.film
    reach = np.tan(np.radians(camera.fov) / 2.0)
    confusion = camera.aperture_radius * np.abs(1.0 / camera.focus_distance - 1.0 / depth)
    inside = np.abs(x) < reach + confusion
    return inside & (np.abs(y) < reach * film.height / film.width + confusion)


def _camera_space(camera: Camera, lamps: Lamps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and forward coordinates of the lamps, metres (of directions: unit)."""
    forward = np.subtract(camera.target, camera.position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    relative = lamps.centres - np.where(lamps.infinite[:, None], 0.0, camera.position)
    return relative @ right, relative @ np.cross(right, forward), relative @ forward


def _disc(sun: Sun) -> tuple[np.ndarray, ...]:
    radius = math.tan(math.radians(0.5 * sun.angle))
    luminance = LUMINANCE @ sun.irradiance / (math.pi * math.sin(math.radians(0.5 * sun.angle)) ** 2)
    return _at_infinity(np.array([radius]), np.array([radius]), np.array([sun.direction]), np.array([luminance]))


def _at_infinity(radii: np.ndarray, extents: np.ndarray, centres: np.ndarray, luminance: np.ndarray) -> tuple[np.ndarray, ...]:
    """The columns of `Lamps` up to `panels`, of lamps without outlines."""
    count = len(radii)
    return centres, radii, extents, np.zeros((count, 3, 3)), luminance, np.zeros((count, 2, 3))


def _pieces(mesh: Mesh) -> np.ndarray:
    """Number of the piece of `mesh`, whose triangles share vertex positions, that each triangle belongs to, int32 `[T]`."""
    from scipy import sparse  # half a second, which who only reads options does not wait for

    points, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners = index.reshape(-1)[mesh.triangles]
    edges = sparse.coo_matrix(
        (np.ones(2 * len(corners)), (np.tile(corners[:, 0], 2), corners[:, 1:].T.ravel())),
        shape=(len(points), len(points)),
    )
    labels = sparse.csgraph.connected_components(edges, directed=False)[1][corners[:, 0]]
    return np.unique(labels, return_inverse=True)[1].astype(np.int32)


def _components(mesh: Mesh, labels: np.ndarray, luminance: float) -> tuple[np.ndarray, ...]:
    """The columns of `Lamps` up to `panels`, of the pieces of `mesh` that its triangles `[T]` belong to.

    A closed piece shows a quarter of its surface on average (Cauchy), an open one
    the length of its vector area.
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    vectors = 0.5 * np.cross(b - a, c - a)
    areas = np.linalg.norm(vectors, axis=1)
    total = np.bincount(labels, areas)
    middles = (a + b + c) / 3.0 * areas[:, None]
    centres = np.stack([np.bincount(labels, column) for column in middles.T], axis=1)
    facing = np.linalg.norm([np.bincount(labels, column) for column in vectors.T], axis=0)
    projected = np.where(facing < 0.1 * total, total / 4.0, facing)
    centres /= total[:, None]
    corners = np.stack((a, b, c)) - centres[labels]
    extents = np.zeros(len(total))
    for corner in corners:
        np.maximum.at(extents, labels, np.linalg.norm(corner, axis=1))
    outlines = _outlines(corners, areas, labels)
    panels = _panels(np.moveaxis(corners, 0, 1), labels)
    return centres, np.sqrt(projected / np.pi), extents, outlines, np.full(len(total), luminance), panels


def _panels(corners: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Half edges `[K, 2, 3]` of the pieces that are parallelograms of two triangles, 0 of the others.

    corners: of triangles, from the middles of their pieces, `[T, 3, 3]`; labels: of the triangles, `[T]`.
    """
    counts = np.bincount(labels)
    edges = np.zeros((len(counts), 2, 3))
    order = np.argsort(labels, kind="stable")
    pairs = order[np.repeat(counts == 2, counts)].reshape(-1, 2)
    one, other = corners[pairs[:, 0]], corners[pairs[:, 1]]
    shared = (one[:, :, None] == other[:, None]).all(3)  # by exact positions: pieces are joined by them
    middle = shared.any(2).sum(1) == 2
    alone = np.argmin(shared.any(2), axis=1)
    pieces, one, alone = labels[pairs[:, 0]][middle], one[middle], alone[middle]
    across = np.argmin(shared[middle].any(1), axis=1)
    rows = np.arange(len(one))
    first, last = one[rows, alone], other[middle][rows, across]
    left, right = one[rows, (alone + 1) % 3], one[rows, (alone + 2) % 3]
    closes = np.linalg.norm(first + last - left - right, axis=1) < 1e-4 * np.linalg.norm(right - left, axis=1)
    edges[pieces[closes]] = 0.5 * np.stack((left - first, right - first), axis=1)[closes]
    return edges


def _outlines(corners: np.ndarray, areas: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Squared half axes `[K, 3, 3]` of the least ellipsoids of the pieces' own proportions that hold their corners.

    corners: of triangles, from the middles of their pieces, `[3, T, 3]`; areas, labels: of the triangles, `[T]`.
    """
    whole = corners.sum(0)
    products = (np.einsum("cti,ctj->tij", corners, corners) + whole[:, :, None] * whole[:, None]) * areas[:, None, None] / 12.0
    total = np.bincount(labels, areas)
    spread = np.stack([np.bincount(labels, column) for column in products.reshape(-1, 9).T], axis=1) / total[:, None]
    spread = spread.reshape(-1, 3, 3)
    widest = np.trace(spread, axis1=1, axis2=2)
    spread += (1e-6 * widest + 1e-30)[:, None, None] * np.eye(3)  # of flat pieces, too
    inverse = np.linalg.inv(spread)[labels]
    reach = np.zeros(len(total))
    for corner in corners:
        np.maximum.at(reach, labels, np.einsum("ti,tij,tj->t", corner, inverse, corner))
    return spread * reach[:, None, None]


def _peaks(radiance: np.ndarray, rotation: float) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Bright spots of a map `[H, W, 3]`, which do not touch: which of them texels belong to, -1 for none; and the columns
    of `Lamps` up to `panels`.

    Extents hold all of what a spot lights of the bilinear interpolant.
    """
    from scipy import ndimage

    height, width = radiance.shape[:2]
    theta = np.pi * (np.arange(height) + 0.5) / height
    solid_angle = np.sin(theta)[:, None] * np.full(width, 2.0 * np.pi**2 / (height * width))
    luminance = radiance.astype(np.float64) @ LUMINANCE
    mean = np.sum(luminance * solid_angle) / np.sum(solid_angle)
    labels, count = ndimage.label(luminance > PEAK * mean, np.ones((3, 3)))
    # The map closes on itself: pieces that meet across its left and right edge are one.
    for row, beside in product(range(height), (-1, 0, 1)):
        if 0 <= row + beside < height:
            left, right = labels[row, 0], labels[row + beside, -1]
            if left > 0 and right > 0 and left != right:
                labels[labels == right] = left
    which = np.unique(labels)[1:]
    phi = 2.0 * np.pi * (np.arange(width) + 0.5) / width - np.pi - np.radians(rotation)
    directions = np.stack(np.broadcast_arrays(
        np.sin(theta)[:, None] * np.sin(phi),
        np.cos(theta)[:, None],
        -np.sin(theta)[:, None] * np.cos(phi),
    ))
    centres = np.stack([ndimage.sum(d * solid_angle, labels, which) for d in directions], axis=1)
    angles = ndimage.sum(solid_angle, labels, which)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    bright = np.flatnonzero(labels)
    number = np.searchsorted(which, labels.ravel()[bright])
    cosine = (centres[number] * directions.reshape(3, -1).T[bright]).sum(1)
    extents = np.zeros(len(which))
    np.maximum.at(extents, number, np.arccos(np.clip(cosine, -1.0, 1.0)) + math.sqrt(2.0) * np.pi / height)
    mean = ndimage.sum(luminance * solid_angle, labels, which) / angles
    texels = np.full(labels.shape, -1)
    texels.reshape(-1)[bright] = number
    extents = np.tan(np.minimum(extents, 1.5))
    return texels, _at_infinity(np.sqrt(angles / np.pi), extents, centres, mean)
