"""Emitters of a scene as discs, and the fraction of the lens that they cover."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.scene.components import connected_components
from bokehguide.scene.emitter_parts import MOST_PARTS, compact_parts
from bokehguide.scene.shapes import joined
from bokehguide.scene.types import Camera, Scene, Sun

PEAK = 10.0
"""Texels of a peak: their luminance exceeds this multiple of the map's mean luminance."""


@dataclass(frozen=True)
class Emitters:
    """N emitters: compact parts of connected emissive triangles, peaks of the environment map, and suns.

    An emitter at infinity has a unit direction as its centre; its radii are tangents of angular radii.

    centres: `[N, 3]`, metres. radii: of discs of the same projected area, `[N]`, metres.
    bounding_radii: of spheres around the centres that contain the emitters, `[N]`. ellipsoids: sums of
    the outer products of the half axes of ellipsoids that contain the emitters, `[N, 3, 3]`, 0 at
    infinity. luminance: of the radiance without textures, `[N]`. half_edges: of emitters that are
    parallelograms of two triangles, `[N, 2, 3]`, 0 for others. infinite: whether an emitter lies at
    infinity, `[N]`. triangle_emitters: the emitter of each scene triangle, -1 for none, int32 `[T]`.
    texel_emitters: the emitter of each texel of the map, -1 for none, `[H, W]`; None without a map.
    """

    centres: np.ndarray
    radii: np.ndarray
    bounding_radii: np.ndarray
    ellipsoids: np.ndarray
    luminance: np.ndarray
    half_edges: np.ndarray
    infinite: np.ndarray
    triangle_emitters: np.ndarray
    texel_emitters: np.ndarray | None


def find_emitters(scene: Scene) -> Emitters:
    """The parts of emissive triangles (`compact_parts`), then the peaks of the environment map, then the suns."""
    of_triangles, columns = _parts(scene)
    near, of_texels = sum(len(column[0]) for column in columns), None
    if scene.environment is not None:
        of_texels, peaks = _peaks(scene.environment.radiance, scene.environment.rotation)
        of_texels = np.where(of_texels >= 0, of_texels + near, -1)
        columns.append(peaks)
    columns += [_disc(sun) for sun in scene.suns]
    columns.append(_at_infinity(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros(0)))
    centres, radii, bounding, ellipsoids, luminance, half_edges = (np.concatenate(arrays) for arrays in zip(*columns))
    infinite = np.arange(len(centres)) >= near
    return Emitters(centres, radii, bounding, ellipsoids, luminance, half_edges, infinite, of_triangles, of_texels)


def _parts(scene: Scene) -> tuple[np.ndarray, list[tuple[np.ndarray, ...]]]:
    """The part of each triangle, -1 for none, int32 `[T]`, and the columns of `Emitters` up to `half_edges` of the parts."""
    meshes = [mesh for mesh in scene.meshes if scene.materials[mesh.material].emits]
    emissive = [np.full(len(mesh.triangles), scene.materials[mesh.material].emits) for mesh in scene.meshes]
    of_triangles = np.full(sum(map(len, emissive)), -1, np.int32)
    if not meshes:
        return of_triangles, []
    mesh, groups = joined(meshes), np.repeat(np.arange(len(meshes)), [len(mesh.triangles) for mesh in meshes])
    labels, parts = compact_parts(mesh, MOST_PARTS, groups)
    luminance = np.array([LUMINANCE @ scene.materials[mesh.material].emission for mesh in meshes])
    of_triangles[np.concatenate(emissive)] = labels
    of_parts = luminance[groups[np.unique(labels, return_index=True)[1]]]
    return of_triangles, [(*parts[:4], of_parts, parts.half_edges)]


def lens_coverage(scene: Scene, emitters: Emitters | None = None) -> float | None:
    """The median fraction of the lens that one emitter covers; None without an emitter in the frame.

    A pixel with its focus point on the axis at distance d projects an emitter of radius R at depth Z
    through that point onto the lens. The radius of the projection is R d / |d - Z|. Emitters count if
    their circle of confusion touches the frame. emitters: the scene's, found here if None.
    """
    camera = scene.camera
    if camera.aperture_radius == 0.0:
        return None
    emitters = find_emitters(scene) if emitters is None else emitters
    x, y, depth = _camera_space(camera, emitters)
    focus_distance = min(camera.focus_distance, FARTHEST_FOCUS)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # The radius of an emitter at infinity is a tangent, and R d / (Z - d) tends to d times that tangent.
        gap = np.where(emitters.infinite, depth, np.abs(depth - focus_distance))
        share = (emitters.radii * focus_distance / gap / camera.aperture_radius) ** 2
        seen = depth > 0.0
        seen &= _touches_frame(x / depth, y / depth, np.where(emitters.infinite, np.inf, depth), scene)
    if scene.environment is not None and not scene.environment.visible:
        seen &= ~emitters.infinite
    return float(np.median(np.minimum(share[seen], 1.0))) if seen.any() else None


def _touches_frame(x: np.ndarray, y: np.ndarray, depth: np.ndarray, scene: Scene) -> np.ndarray:
    """Whether the circles of confusion of points touch the frame. x, y: positions divided by `depth`."""
    camera, film = scene.camera, scene.film
    reach = np.tan(np.radians(camera.fov) / 2.0)
    confusion = camera.aperture_radius * np.abs(1.0 / camera.focus_distance - 1.0 / depth)
    inside = np.abs(x) < reach + confusion
    return inside & (np.abs(y) < reach * film.height / film.width + confusion)


def _camera_space(camera: Camera, emitters: Emitters) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and forward coordinates of the centres, metres; of unit directions at infinity."""
    forward = np.subtract(camera.target, camera.position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    relative = emitters.centres - np.where(emitters.infinite[:, None], 0.0, camera.position)
    return relative @ right, relative @ np.cross(right, forward), relative @ forward


def _disc(sun: Sun) -> tuple[np.ndarray, ...]:
    """The columns of `Emitters` up to `half_edges` of one sun."""
    radius = math.tan(math.radians(0.5 * sun.angle))
    luminance = LUMINANCE @ sun.irradiance / (math.pi * math.sin(math.radians(0.5 * sun.angle)) ** 2)
    return _at_infinity(np.array([radius]), np.array([radius]), np.array([sun.direction]), np.array([luminance]))


def _at_infinity(radii: np.ndarray, bounding: np.ndarray, centres: np.ndarray, luminance: np.ndarray) -> tuple[np.ndarray, ...]:
    """The columns of `Emitters` up to `half_edges` of emitters at infinity."""
    count = len(radii)
    return centres, radii, bounding, np.zeros((count, 3, 3)), luminance, np.zeros((count, 2, 3))


def _peaks(radiance: np.ndarray, rotation: float) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """The peak of each texel `[H, W]`, -1 for none, and the columns of `Emitters` up to `half_edges` of the peaks.

    radiance: `[H, W, 3]`. Texels of one peak touch at a side or a corner. The bounding radii contain
    the support of the bilinear interpolant.
    """
    height, width = radiance.shape[:2]
    theta = np.pi * (np.arange(height) + 0.5) / height
    solid_angle = np.sin(theta)[:, None] * np.full(width, 2.0 * np.pi**2 / (height * width))
    luminance = radiance.astype(np.float64) @ LUMINANCE
    mean = np.sum(luminance * solid_angle) / np.sum(solid_angle)
    bright, number = _connected_texels(luminance > PEAK * mean)
    texels = np.full(height * width, -1)
    texels[bright] = number
    row, column = bright // width, bright % width
    phi = 2.0 * np.pi * (column + 0.5) / width - np.pi - np.radians(rotation)
    sine = np.sin(theta)[row]
    directions = np.stack((sine * np.sin(phi), np.cos(theta)[row], -sine * np.cos(phi)))
    solid_angle, luminance = solid_angle.reshape(-1)[bright], luminance.reshape(-1)[bright]
    centres = np.stack([np.bincount(number, d * solid_angle) for d in directions], axis=1)
    angles = np.bincount(number, solid_angle)
    centres = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    cosine = (centres[number] * directions.T).sum(1)
    bounding = np.zeros(len(angles))
    np.maximum.at(bounding, number, np.arccos(np.clip(cosine, -1.0, 1.0)) + math.sqrt(2.0) * np.pi / height)
    bounding = np.tan(np.minimum(bounding, 1.5))
    mean = np.bincount(number, luminance * solid_angle) / angles
    return texels.reshape(height, width), _at_infinity(np.sqrt(angles / np.pi), bounding, centres, mean)


def _connected_texels(bright: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the texels of `bright` `[H, W]`, and the connected component of each. The map is periodic along u."""
    height, width = bright.shape
    texels = np.flatnonzero(bright)
    number = np.full((height + 1, width), -1)  # a dark row below the map
    number[:-1][bright] = np.arange(len(texels))
    row, column = texels // width, texels % width
    beside = [number[row + down, (column + right) % width] for down, right in ((0, 1), (1, -1), (1, 0), (1, 1))]
    pairs = np.stack((np.tile(np.arange(len(texels)), 4), np.concatenate(beside)), axis=1)
    return texels, connected_components(pairs[pairs[:, 1] >= 0], len(texels))
