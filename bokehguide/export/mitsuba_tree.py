"""Scenes for Mitsuba 3, as the nested dictionaries that `mi.load_dict` reads.

Arrays stay arrays: images are `Bitmap`, meshes `Geometry`, and transforms `[4, 4]`. `mitsuba_xml` writes them into files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.export.mitsuba_materials import Bitmap, color, mitsuba_bsdf
from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.scene.types import Environment, Material, Mesh, Scene, Sun

NEAR, FAR = 1e-4, 1e5
"""Clipping planes of Mitsuba's camera, metres."""
APART = 1e-5
"""Distance of the back of a two-sided emitter behind its front, in scene sizes."""


@dataclass(frozen=True)
class Geometry:
    """Triangles of a shape: vertices float32 `[V, 3]`, triangles int32 `[T, 3]`, normals `[V, 3]` and uvs `[V, 2]` or None."""

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None


def scene_tree(scene: Scene, bsdf: Callable[[Material], dict[str, Any]] = mitsuba_bsdf) -> dict[str, Any]:
    """The dictionary of a scene. bsdf: makes the BSDF of a material; a shape refers to it as `material` and its number."""
    tree: dict[str, Any] = {"type": "scene", "integrator": integrator(scene), "sensor": _sensor(scene)}
    used = sorted({mesh.material for mesh in scene.meshes})
    tree |= {f"material{number}": bsdf(scene.materials[number]) for number in used}
    size = max(float(np.ptp(mesh.vertices, axis=0).max()) for mesh in scene.meshes)
    for number, mesh in enumerate(scene.meshes):
        material = scene.materials[mesh.material]
        tree[f"mesh{number}"] = _shape(mesh, material)
        if material.emits and material.double_sided:
            tree[f"mesh{number}back"] = _shape(_back(mesh, APART * size), material)
    if scene.environment is not None:
        tree["environment"] = environment_emitter(scene.environment)
    tree |= {f"sun{number}": _sun(sun) for number, sun in enumerate(scene.suns)}
    return tree


def integrator(scene: Scene) -> dict[str, Any]:
    """The integrator, without Russian roulette: paths end at the last segment."""
    return {"type": "path", "max_depth": scene.film.max_depth, "rr_depth": 100}


def _sensor(scene: Scene) -> dict[str, Any]:
    """A thin lens, or a pinhole, at the camera."""
    camera = scene.camera
    lens: dict[str, Any] = {"type": "perspective"}  # thinlens refuses a radius of 0
    if camera.aperture_radius > 0.0:
        focus = min(camera.focus_distance, FARTHEST_FOCUS)
        lens = {"type": "thinlens", "aperture_radius": camera.aperture_radius, "focus_distance": focus}
    film = {"type": "hdrfilm", "width": scene.film.width, "height": scene.film.height, "rfilter": {"type": "box"}}
    return lens | {
        "to_world": _look_at(np.array(camera.position), np.array(camera.target), np.array(camera.up)),
        "fov": camera.fov,
        "fov_axis": "x",
        "near_clip": NEAR,
        "far_clip": FAR,
        "film": film | {"pixel_format": "rgb", "component_format": "float32"},
        "sampler": {"type": "independent"},
    }


def _look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The matrix `[4, 4]` of a sensor of Mitsuba: x to the left, y up, z forward."""
    forward = (target - position) / np.linalg.norm(target - position)
    left = np.cross(up, forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3] = np.stack((left, np.cross(forward, left), forward, position), axis=1)
    return matrix


def _shape(mesh: Mesh, material: Material) -> dict[str, Any]:
    """A mesh with its material, and with an emitter if it emits."""
    texture = next((t for t in (material.base_color_texture, material.emission_texture) if t is not None), None)
    uvs = None if mesh.uvs is None else mesh.uvs[:, 0 if texture is None else texture.uv_set]
    normals = None if material.emits else mesh.normals  # emission is constant over directions
    shape: dict[str, Any] = {"type": "ply", "geometry": Geometry(mesh.vertices, mesh.triangles, normals, uvs)}
    if normals is None:
        shape["face_normals"] = True  # else Mitsuba averages the normals of the triangles at a vertex
    shape["bsdf"] = {"type": "ref", "id": f"material{mesh.material}"}
    if material.emits:
        shape["emitter"] = {"type": "area", "radiance": color(material.emission, material.emission_texture)}
    return shape


def _back(mesh: Mesh, distance: float) -> Mesh:
    """The other face of every triangle of a flat mesh, `distance` behind it."""
    corners = mesh.vertices[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    vertices = (corners - distance * normals[:, None])[:, ::-1].reshape(-1, 3)
    triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    uvs = None if mesh.uvs is None else mesh.uvs[mesh.triangles][:, ::-1].reshape(len(vertices), -1, 2)
    return Mesh(vertices, triangles, mesh.material, uvs=uvs)


def environment_emitter(environment: Environment) -> dict[str, Any]:
    """The map with Mitsuba's rows, rotated: its centre lies at +z in Mitsuba and at -z in bokehguide.

    Mitsuba's first and last rows are the poles and its columns are texels; with twice as
    many rows plus one, both bilinear interpolants agree.
    """
    radiance = np.asarray(environment.radiance, np.float32)
    if radiance.shape[:2] == (1, 1):
        return {"type": "constant", "radiance": {"type": "rgb", "value": radiance[0, 0].tolist()}}
    padded = np.pad(radiance, ((1, 1), (0, 0), (0, 0)), mode="edge")
    rows = np.empty((2 * len(radiance) + 1, *radiance.shape[1:]), np.float32)
    rows[1::2], rows[0::2] = radiance, 0.5 * (padded[1:] + padded[:-1])
    angle = np.radians(180.0 + environment.rotation)
    turn = np.eye(4)
    turn[0, 0] = turn[2, 2] = np.cos(angle)
    turn[0, 2], turn[2, 0] = np.sin(angle), -np.sin(angle)
    return {"type": "envmap", "bitmap": Bitmap(rows), "to_world": turn}


def _sun(sun: Sun) -> dict[str, Any]:
    """A sun as a light without a disc."""
    direction = [-component for component in sun.direction]
    return {"type": "directional", "direction": direction, "irradiance": {"type": "rgb", "value": list(sun.irradiance)}}
