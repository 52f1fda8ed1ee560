"""A camera, a lens and a sky for a model that comes without them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.builtin.parts import sky
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.models import load_model
from bokehguide.scene.overrides import Overrides, override_camera
from bokehguide.scene.tables import ANGLE_OF_VIEW
from bokehguide.scene.types import Camera, Film, Mesh, ModelCamera, Scene

VIEW = np.array([0.5, 0.4, 0.768115])
"""Unit vector from the model's middle towards the camera: three quarters, from above."""

FOV = 40.0
UP = (0.0, 1.0, 0.0)
SOFT_SKY = sky((-90, (0.15, 0.15, 0.15)), (-5, (0.25, 0.25, 0.25)), (5, (0.6, 0.62, 0.65)), (90, (1.0, 1.05, 1.1)))
"""White above, grey at the horizon, dim below."""

APERTURE = 0.02
"""Aperture radius as a share of the focus distance."""
MARGIN = 1.08
"""Room around the model, as a factor on the camera's distance."""


FRAME = "frame"
"""What `--camera` calls the camera that frames the model."""


def model_scene(path: Path, overrides: Overrides, files: SceneFiles) -> Scene:
    """The model at `path` as a photograph; `files` are those that it may read.

    The camera is the one that `overrides` name or the file's first. Where it has none, or
    `overrides` say where to stand or look, a camera frames the whole model from three
    quarters. The lens is focused on the nearest part of the model in the frame. Where
    nothing emits and `overrides` bring no environment there is a soft sky.
    """
    model = load_model(path, files=files)
    film = Film()
    points = _points(model.meshes, str(path))
    aspect = (overrides.height or film.height) / (overrides.width or film.width)
    own = _choose(model.cameras, overrides, str(path))
    camera = _frame(points, overrides, aspect) if own is None else _stand(own, points, overrides, aspect)
    meshes = model.meshes + model.lamps
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
        honoured=model.honoured,
    )


def _points(meshes: tuple[Mesh, ...], file: str) -> np.ndarray:
    """All vertices that triangles use, float64 `[N, 3]`."""
    parts = []
    for mesh in meshes:
        used = np.zeros(len(mesh.vertices), dtype=bool)
        used[mesh.triangles] = True
        parts.append(mesh.vertices[used])
    points = np.concatenate(parts).astype(np.float64)
    if not np.ptp(points, axis=0).any():
        raise BokehguideError(f"{file}: all vertices are one point; give a model with a surface")
    return points


def _choose(cameras: tuple[ModelCamera, ...], overrides: Overrides, file: str) -> ModelCamera | None:
    """The camera that `overrides` name or number, else the first; None for the framing one."""
    wanted = overrides.camera
    if wanted is None:
        placed = overrides.camera_position is not None or overrides.camera_target is not None
        return None if placed or not cameras else cameras[0]
    known = {str(number): camera for number, camera in enumerate(cameras)}
    known |= {camera.name: camera for camera in reversed(cameras)}
    if wanted not in known and wanted != FRAME:
        names = printable(", ".join(f"{number} ({camera.name})" for number, camera in enumerate(cameras)) or "none", 600)
        raise BokehguideError(
            f"--camera: {wanted!r} is no camera of {file}; it has {names}, and {FRAME!r} frames it all"
        )
    return known.get(wanted)


def _stand(own: ModelCamera, points: np.ndarray, overrides: Overrides, aspect: float) -> Camera:
    """A model's own camera; its vertical field of view holds, whatever the film's shape."""
    position, forward, up = np.array(own.position), np.array(own.forward), np.array(own.up)
    across = np.degrees(2.0 * np.arctan(np.tan(np.radians(own.vertical_fov) / 2.0) / aspect))
    fov = float(min(across, ANGLE_OF_VIEW.high)) if overrides.fov is None else overrides.fov
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    away = max(abs(float((middle - position) @ forward)), 1e-3)
    focus = _nearest_depth(points, position, position + away * forward, fov, aspect, up)
    target = position + focus * forward
    return Camera(own.position, tuple(map(float, target)), own.up, fov, APERTURE * focus, focus)


def _frame(points: np.ndarray, overrides: Overrides, aspect: float) -> Camera:
    """A camera on all `points`; position, target and fov come from `overrides` if there."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    fov = FOV if overrides.fov is None else overrides.fov
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


def _axes(forward: np.ndarray, up: Sequence[float] = UP) -> tuple[np.ndarray, np.ndarray]:
    """Right and up of a camera that looks along `forward`, not along `up`."""
    right = np.cross(forward, up)
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
    points: np.ndarray,
    position: np.ndarray,
    target: np.ndarray,
    fov: float,
    aspect: float,
    up: Sequence[float] = UP,
) -> float:
    """Least depth of the points in the frame, or the target's where none is."""
    distance = np.linalg.norm(target - position)
    forward = (target - position) / max(distance, 1e-30)
    right, up = _axes(forward, up)
    relative = points - position
    depth = relative @ forward
    reach = np.tan(np.radians(fov) / 2.0) * depth
    seen = (depth > 0.0) & (np.abs(relative @ right) < reach)
    seen &= np.abs(relative @ up) < reach * aspect
    return float(depth[seen].min()) if seen.any() else float(max(distance, 1e-6))
