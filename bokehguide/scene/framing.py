"""Models as scenes: a camera, a lens and a sky where the model has none."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.environments import sky
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.model_files import load_model
from bokehguide.scene.overrides import Overrides, override_camera
from bokehguide.scene.tables import ANGLE_OF_VIEW
from bokehguide.scene.types import Camera, FilmSettings, Mesh, ModelCamera, Scene, Vector, as_vector

VIEW = np.array([0.5, 0.4, 0.768115])
"""Unit vector from the model's centre towards the camera: a three-quarter view from above."""

FOV = 40.0
UP = (0.0, 1.0, 0.0)
SOFT_SKY = sky((-90, (0.15, 0.15, 0.15)), (-5, (0.25, 0.25, 0.25)), (5, (0.6, 0.62, 0.65)), (90, (1.0, 1.05, 1.1)))
"""White at the zenith, grey at the horizon, dim below."""

APERTURE = 0.02
"""Aperture radius relative to the focus distance."""
MARGIN = 1.08
"""Margin around the model, as a factor on the camera's distance."""

FRAME = "frame"
"""Name of the framing camera for `--camera`."""


def model_scene(path: Path, overrides: Overrides, files: SceneFiles) -> Scene:
    """The model at `path` as a scene. files: the files that the model may name.

    The camera is the one that `overrides` select, or the file's first. Without one, or if `overrides`
    set its position or target, a camera frames the whole model in a three-quarter view. The lens
    focuses on the nearest vertex in the frame. A model without emitters gets a soft sky, unless
    `overrides` set the environment. Raises BokehguideError as `load_model` does.
    """
    model = load_model(path, files)
    film = FilmSettings()
    points = _used_vertices(model.meshes, str(path))
    aspect = (overrides.height or film.height) / (overrides.width or film.width)
    own = _select_camera(model.cameras, overrides, str(path))
    camera = _framing_camera(points, overrides, aspect) if own is None else _with_lens(own, points, overrides, aspect)
    meshes = model.meshes + model.emitters
    lit = model.suns or any(model.materials[mesh.material].emits for mesh in meshes)
    return Scene(
        name=path.stem,
        camera=override_camera(asdict(camera), overrides, str(path), files),
        meshes=meshes,
        materials=model.materials,
        film=film,
        environment=None if lit or overrides.environment is not None else SOFT_SKY,
        suns=model.suns,
        warnings=model.warnings,
        supported=model.supported,
    )


def _used_vertices(meshes: tuple[Mesh, ...], file: str) -> np.ndarray:
    """All vertices of triangles, float64 `[N, 3]`."""
    parts = []
    for mesh in meshes:
        used = np.zeros(len(mesh.vertices), dtype=bool)
        used[mesh.triangles] = True
        parts.append(mesh.vertices[used])
    points = np.concatenate(parts).astype(np.float64)
    if not np.ptp(points, axis=0).any():
        raise BokehguideError(f"{file}: all vertices are one point; give a model with a surface")
    return points


def _select_camera(cameras: tuple[ModelCamera, ...], overrides: Overrides, file: str) -> ModelCamera | None:
    """The camera that `overrides` select, or the first; None for the framing camera."""
    wanted = overrides.camera
    if wanted is None:
        placed = overrides.camera_position is not None or overrides.camera_target is not None
        return None if placed or not cameras else cameras[0]
    known = {str(number): camera for number, camera in enumerate(cameras)}
    known |= {camera.name: camera for camera in reversed(cameras)}
    if wanted not in known and wanted != FRAME:
        names = printable(", ".join(f"{number} ({camera.name})" for number, camera in enumerate(cameras)) or "none", 600)
        raise BokehguideError(f"--camera: {wanted!r} is no camera of {file}; it has {names}; {FRAME!r} frames the model")
    return known.get(wanted)


def _with_lens(own: ModelCamera, points: np.ndarray, overrides: Overrides, aspect: float) -> Camera:
    """A model's camera with a lens. It keeps its vertical field of view for every aspect ratio."""
    position, forward = np.array(own.position), np.array(own.forward)
    horizontal = np.degrees(2.0 * np.arctan(np.tan(np.radians(own.vertical_fov) / 2.0) / aspect))
    fov = float(min(horizontal, ANGLE_OF_VIEW.high)) if overrides.fov is None else overrides.fov
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    depth = max(abs(float((middle - position) @ forward)), 1e-3)
    focus = _nearest_depth(points, position, position + depth * forward, fov, aspect, own.up)
    target = position + focus * forward
    return Camera(own.position, as_vector(target), own.up, fov, APERTURE * focus, focus)


def _framing_camera(points: np.ndarray, overrides: Overrides, aspect: float) -> Camera:
    """A camera that frames all `points`. Position, target and fov of `overrides` take precedence."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    fov = FOV if overrides.fov is None else overrides.fov
    target = middle if overrides.camera_target is None else np.array(overrides.camera_target)
    position = target + VIEW * _fitting_distance(points - target, fov, aspect)
    if overrides.camera_position is not None:
        position = np.array(overrides.camera_position)
    focus = _nearest_depth(points, position, target, fov, aspect)
    return Camera(
        position=as_vector(position), target=as_vector(target), fov=fov, aperture_radius=APERTURE * focus, focus_distance=focus
    )


def _axes(forward: np.ndarray, up: Vector = UP) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the right and up of a camera that looks along `forward`."""
    right = np.cross(forward, up)
    right /= max(np.linalg.norm(right), 1e-30)
    return right, np.cross(right, forward)


def _fitting_distance(relative: np.ndarray, fov: float, aspect: float) -> float:
    """Distance along VIEW from which the frame contains all points `[N, 3]`, given relative to the target."""
    right, up = _axes(-VIEW)
    reach = np.tan(np.radians(fov) / 2.0)
    distance = relative @ VIEW + np.maximum(np.abs(relative @ right) / reach, np.abs(relative @ up) / (reach * aspect))
    return MARGIN * float(distance.max())


def _nearest_depth(
    points: np.ndarray, position: np.ndarray, target: np.ndarray, fov: float, aspect: float, up: Vector = UP
) -> float:
    """The smallest depth of the points in the frame, or the target's depth if there are none."""
    distance = np.linalg.norm(target - position)
    forward = (target - position) / max(distance, 1e-30)
    right, upwards = _axes(forward, up)
    relative = points - position
    depth = relative @ forward
    reach = np.tan(np.radians(fov) / 2.0) * depth
    seen = (depth > 0.0) & (np.abs(relative @ right) < reach)
    seen &= np.abs(relative @ upwards) < reach * aspect
    return float(depth[seen].min()) if seen.any() else float(max(distance, 1e-6))
