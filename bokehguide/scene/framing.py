"""A camera, a lens and a sky for a model that comes without them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.builtin.parts import sky
from bokehguide.scene.models import load_model
from bokehguide.scene.overrides import Overrides, override_camera
from bokehguide.scene.types import Camera, Film, Mesh, Scene

VIEW = np.array([0.5, 0.4, 0.768115])
"""Unit vector from the model's middle towards the camera: three quarters, from above."""

FOV = 40.0
SOFT_SKY = sky((-90, (0.15, 0.15, 0.15)), (-5, (0.25, 0.25, 0.25)), (5, (0.6, 0.62, 0.65)), (90, (1.0, 1.05, 1.1)))
"""White above, grey at the horizon, dim below."""

APERTURE = 0.02
"""Aperture radius as a share of the focus distance."""
MARGIN = 1.08
"""Room around the model, as a factor on the camera's distance."""


def model_scene(path: Path, overrides: Overrides) -> Scene:
    """The model at `path` as a photograph.

    The camera frames the whole model from three quarters; the lens is focused on
    the nearest part of the model. Where nothing emits and `overrides` bring no
    environment there is a soft sky.
    """
    model = load_model(path)
    film = Film()
    camera = _frame(model.meshes, overrides, film, str(path))
    lit = any(model.materials[mesh.material].emits for mesh in model.meshes)
    return Scene(
        name=path.stem,
        camera=override_camera(asdict(camera), overrides, str(path)),
        meshes=model.meshes,
        materials=model.materials,
        film=film,
        environment=None if lit or overrides.environment is not None else SOFT_SKY,
        warnings=model.warnings,
    )


def _frame(meshes: tuple[Mesh, ...], overrides: Overrides, film: Film, file: str) -> Camera:
    """A camera on all of `meshes`; position, target and fov come from `overrides` if there."""
    points = np.concatenate([mesh.vertices[np.unique(mesh.triangles)] for mesh in meshes])
    points = points.astype(np.float64)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    if not np.ptp(points, axis=0).any():
        raise BokehguideError(f"{file}: all vertices are one point; give a model with a surface")
    fov = FOV if overrides.fov is None else overrides.fov
    aspect = (overrides.height or film.height) / (overrides.width or film.width)
    target = middle if overrides.camera_target is None else np.array(overrides.camera_target)
    position = target + VIEW * _fitting_distance(points - target, fov, aspect)
    if overrides.camera_position is not None:
        position = np.array(overrides.camera_position)
    focus = _nearest_depth(points, position, target, fov, aspect)
    return Camera(
        position=tuple(map(float, position)),
        target=tuple(map(float, target)),
        fov=fov,
        aperture_radius=APERTURE * focus,
        focus_distance=focus,
    )


def _axes(forward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Right and up of a camera that looks along `forward`, not along y."""
    right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= max(np.linalg.norm(right), 1e-30)
    return right, np.cross(right, forward)


def _fitting_distance(relative: np.ndarray, fov: float, aspect: float) -> float:
    """Distance along VIEW from which all points `relative` to the target are in the frame."""
    right, up = _axes(-VIEW)
    reach = np.tan(np.radians(fov) / 2.0)
    distance = relative @ VIEW + np.maximum(
        np.abs(relative @ right) / reach, np.abs(relative @ up) / (reach * aspect)
    )
    return MARGIN * float(distance.max())


def _nearest_depth(
    points: np.ndarray, position: np.ndarray, target: np.ndarray, fov: float, aspect: float
) -> float:
    """Least depth of the points in the frame, or the target's where none is."""
    distance = np.linalg.norm(target - position)
    forward = (target - position) / max(distance, 1e-30)
    right, up = _axes(forward)
    relative = points - position
    depth = relative @ forward
    reach = np.tan(np.radians(fov) / 2.0) * depth
    seen = (depth > 0.0) & (np.abs(relative @ right) < reach)
    seen &= np.abs(relative @ up) < reach * aspect
    return float(depth[seen].min()) if seen.any() else float(max(distance, 1e-6))
