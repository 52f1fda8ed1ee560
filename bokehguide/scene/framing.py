"""Models as scenes: a camera, a lens and a sky where the model has none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.cameras import read_camera
from bokehguide.scene.composition import FOV, compose, with_lens
from bokehguide.scene.emitters import find_emitters
from bokehguide.scene.environments import sky
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.model import Model, ModelCamera
from bokehguide.scene.model_files import load_model
from bokehguide.scene.overrides import ChosenCamera, Overrides, override_camera, override_environment, override_film
from bokehguide.scene.sight import Sight
from bokehguide.scene.tables import ANGLE_OF_VIEW, override_place
from bokehguide.scene.types import Camera, FilmSettings, Mesh, Scene, Vector, as_vector
from bokehguide.scene.units import unit_warning
from bokehguide.scene.validation import checked

SOFT_SKY = sky((-90, (0.15, 0.15, 0.15)), (-5, (0.25, 0.25, 0.25)), (5, (0.6, 0.62, 0.65)), (90, (1.0, 1.05, 1.1)))
"""White at the zenith, grey at the horizon, dim below."""
SKY_EXPOSURE = 1.0
"""Exposure in EV of a model before the soft sky, whose light gives an upright white surface half the radiance of diffuse white. A
meter would show the sky, which fills most of the frame, as middle grey."""

GROUND, FLAT = 3.0, 0.05
"""A ground is flat, of a thickness up to FLAT of its length, and its diagonal exceeds GROUND times that of all smaller meshes."""
GLOW = 1.0
"""Greatest emission of a mesh that does not count as light: labels, screens and unlit surfaces."""
LEAST_LIGHT = 1e-3
"""Least sum of emission times area of the brighter meshes that counts as light, relative to the squared diagonal of the model.
Smaller emitters, such as the landing lights of an aeroplane, give less than a thousandth of the light of the sky."""

SKY_LINES = 500
"""Lines of sight that look for the sky."""
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
"""Radians between neighbouring points of a Fibonacci lattice on the sphere."""

FRAME = "frame"
"""Name of the framing camera for `--camera`."""


def model_scene(path: Path, overrides: Overrides, files: SceneFiles, lit: bool = False) -> tuple[Scene, ChosenCamera]:
    """The model at `path` as a scene, and its camera. files: the files that the model may name. lit: whether other lights follow.

    The camera is the one that `overrides` select, or the file's first. Without one, or if `overrides` set its position or
    target, `compose` chooses the view. A camera without a lens focuses on the part of the model in the middle of the frame, and
    highlights at infinity have a diameter of HIGHLIGHT of its width. A model without light (`_lit`) gets a soft sky, unless
    other lights follow or `overrides` set the environment. A camera outside a model before the soft sky has the exposure
    SKY_EXPOSURE. Raises BokehguideError as `load_model` does.
    """
    model = load_model(path, files, state=overrides.state)
    meshes = model.meshes + model.emitters
    own = _select_camera(model.cameras, overrides, str(path))
    under_sky = overrides.environment is None and not lit and not _lit(model)
    scene = Scene(
        name=path.stem,
        camera=Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),
        meshes=meshes,
        materials=model.materials,
        film=override_film(model.film or FilmSettings(), overrides),
        environment=SOFT_SKY if under_sky else model.environment,
        suns=model.suns,
        warnings=model.warnings,
        supported=model.supported,
        likely_mistakes=tuple(unit_warning(path, model.meshes)),
    )
    scene = override_environment(scene, overrides)
    scene = _framed(scene, model, overrides, str(path)) if own is None else _photographed(scene, own, overrides)
    if under_sky and scene.film.exposure is None and _outside(scene.camera.position, model.meshes):
        scene = replace(scene, film=replace(scene.film, exposure=SKY_EXPOSURE))
    elif under_sky:
        scene = replace(scene, warnings=(*scene.warnings, *_hidden_sky(scene, path)))
    return scene, override_camera(asdict(scene.camera), overrides, str(path), files)


def _hidden_sky(scene: Scene, path: Path) -> Iterator[str]:
    """A warning if no line of sight leads from the camera of a model to the sky, its only light."""
    clear = tuple(mesh for mesh in scene.meshes if scene.materials[mesh.material].transmission == 0.0)
    if not clear:
        return
    turns = np.arange(SKY_LINES) + 0.5
    height, angle = 1.0 - 2.0 * turns / SKY_LINES, GOLDEN_ANGLE * turns
    flat = np.sqrt(1.0 - height**2)
    directions = np.stack([flat * np.cos(angle), height, flat * np.sin(angle)], axis=1)
    seen = Sight(clear, scene.materials).along(np.array(scene.camera.position), directions)
    if (seen.mesh >= 0).all():
        shell = printable(repr(clear[seen.mesh[seen.distance.argmax()]].name), 120)
        yield (
            f"{path.name}: surfaces such as {shell} hide the sky, the only light, from the camera; give the model a light, or "
            "leave the surfaces out"
        )


def _lit(model: Model) -> bool:
    """Whether `model` has a light: a sun, an environment, an emitter, or meshes with emission beyond GLOW and LEAST_LIGHT."""
    if model.suns or model.emitters or model.environment is not None:
        return True
    emission = [max(model.materials[mesh.material].emission) for mesh in model.meshes]
    power = sum(each * _area(mesh) for mesh, each in zip(model.meshes, emission) if each > GLOW)
    return power > LEAST_LIGHT * _diagonal(model.meshes) ** 2


def _area(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


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


def _without_grounds(meshes: tuple[Mesh, ...]) -> tuple[Mesh, ...]:
    """`meshes` by size, without planes that would make all others tiny in the frame."""
    left = sorted(meshes, key=lambda mesh: _diagonal((mesh,)))
    while len(left) > 1:
        *rest, largest = left
        extent = np.ptp(_bounds((largest,)), axis=0)
        others = _diagonal(tuple(rest))
        if extent.min() > FLAT * extent.max() or others == 0.0 or _diagonal((largest,)) <= GROUND * others:
            break
        left = rest
    return tuple(left)


def _outside(position: Vector, meshes: tuple[Mesh, ...]) -> bool:
    """Whether a position is outside the bounding box of `meshes`, but for grounds: in no room."""
    low, high = _bounds(_without_grounds(meshes))
    return bool((position < low).any() or (position > high).any())


def _diagonal(meshes: tuple[Mesh, ...]) -> float:
    return float(np.linalg.norm(np.ptp(_bounds(meshes), axis=0)))


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
        raise BokehguideError(
            f"{override_place('camera')}: {wanted!r} is no camera of {file}; it has {names}; {FRAME!r} frames the model"
        )
    return known.get(str(wanted))


def _photographed(scene: Scene, own: ModelCamera, overrides: Overrides) -> Scene:
    """`scene` with a model's camera and a lens. The frame shows the camera's fields of view for every aspect ratio.

    Another field of view keeps the f-number of the camera's own lens.
    """
    position, forward, film = np.array(own.position), np.array(own.forward), scene.film
    slope = _slope(own, film)
    horizontal = np.degrees(2.0 * np.arctan(slope))
    fov = float(min(horizontal, ANGLE_OF_VIEW.high)) if overrides.fov is None else overrides.fov
    middle = np.mean(_bounds(scene.meshes), axis=0)
    target = position + max(abs(float((middle - position) @ forward)), 1e-3) * forward
    camera = Camera(own.position, as_vector(target), own.up, fov, sensor_width=_sensor_width(own, film))
    if own.lens is None or own.lens.focus_distance is None:
        camera = with_lens(camera, Sight(scene.meshes, scene.materials), film)
    if own.lens is not None:
        focus = own.lens.focus_distance or camera.focus_distance
        zoom = 1.0 if overrides.fov is None else float(slope / np.tan(np.radians(fov) / 2.0))
        camera = replace(camera, aperture_radius=own.lens.aperture_radius * zoom, focus_distance=focus)
    return replace(scene, camera=camera)


def _slope(own: ModelCamera, film: FilmSettings) -> float:
    """Half the width of the frame of a model's camera at a depth of 1."""
    slope = np.tan(np.radians(own.vertical_fov) / 2.0) * film.width / film.height
    if own.horizontal_fov is not None:
        slope = max(slope, np.tan(np.radians(own.horizontal_fov) / 2.0))
    return float(slope)


def _sensor_width(own: ModelCamera, film: FilmSettings) -> float:
    """The width in millimetres of the sensor of a model's camera, which grows with the frame."""
    if own.lens is None or own.horizontal_fov is None:
        return Camera.sensor_width
    return own.lens.sensor_width * float(_slope(own, film) / np.tan(np.radians(own.horizontal_fov) / 2.0))


def _framed(scene: Scene, model: Model, overrides: Overrides, file: str) -> Scene:
    """`scene` with a camera that frames `model`, but for grounds. Position, target and fov of `overrides` take precedence.

    The sensor is that of the model's first camera. An environment of the model's own does not turn.
    """
    subject = _without_grounds(model.meshes)
    points, film = _used_vertices(subject, file), scene.film
    fov = FOV if overrides.fov is None else overrides.fov
    sensor = _sensor_width(model.cameras[0], film) if model.cameras else Camera.sensor_width
    sight = Sight(scene.meshes, scene.materials)
    focusing = sight if len(subject) == len(model.meshes) else Sight(subject, scene.materials)
    position, target = overrides.camera_position, overrides.camera_target
    if position is None:
        emitters = find_emitters(checked(scene, file))  # without triangles of no area
        turnable = model.environment is None or overrides.environment is not None
        view = compose(points, sight, emitters, film, fov, turnable)
        camera, environment = view.camera if focusing is sight else with_lens(view.camera, focusing, film), scene.environment
        if view.rotation and environment is not None and overrides.environment_rotation is None:
            scene = replace(scene, environment=replace(environment, rotation=environment.rotation + view.rotation))
        if target is None:
            return replace(scene, camera=replace(camera, sensor_width=sensor))
        position = camera.position
    target = target or as_vector(np.mean([points.min(axis=0), points.max(axis=0)], axis=0))
    values = {"position": position, "target": target, "fov": fov, "sensor_width": sensor}
    camera = read_camera(values, file, SceneFiles(Path()))
    return replace(scene, camera=with_lens(camera, focusing, film))


def _bounds(meshes: tuple[Mesh, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest coordinates `[3]` of all vertices."""
    low = np.min([mesh.vertices.min(axis=0) for mesh in meshes], axis=0)
    return low.astype(np.float64), np.max([mesh.vertices.max(axis=0) for mesh in meshes], axis=0).astype(np.float64)
