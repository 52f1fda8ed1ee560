"""Overrides: scene values that the command line replaces."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.cameras import SENSOR_WIDTH, focal_length, read_camera
from bokehguide.scene.environments import constant_radiance, load_environment_map
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.tables import ANGLE_OF_VIEW, IN_FRONT, NOT_NEGATIVE, POSITIVE, Table
from bokehguide.scene.types import Camera, Environment, Scene, Vector

NUMBERS = {"f_number": POSITIVE, "aperture_radius": NOT_NEGATIVE, "focus_distance": IN_FRONT, "fov": ANGLE_OF_VIEW}


@dataclass(frozen=True)
class Overrides:
    """Values that replace a scene's own; None keeps the scene's.

    width, height: pixels. environment: the path of a `.hdr` or `.exr` map, or a radiance "R,G,B".
    f_number: relative to the scene's focal length, or to the focal length with the scene's field of
    view on a sensor 36 mm wide. aperture_radius, focus_distance, camera_position, camera_target:
    metres. fov: horizontal, degrees; a scene with a focal length keeps its sensor and f-number.
    camera: name or number of a model's camera, or "frame" for a camera that frames the model.

    Raises BokehguideError, naming the command-line option, for a value out of range.
    """

    width: int | None = None
    height: int | None = None
    environment: str | None = None
    f_number: float | None = None
    aperture_radius: float | None = None
    focus_distance: float | None = None
    camera_position: Vector | None = None
    camera_target: Vector | None = None
    fov: float | None = None
    camera: str | None = None

    def __post_init__(self) -> None:
        given = {key: value for key, value in asdict(self).items() if value is not None}
        options = _Options(given, "", "", asdict(self))
        options.exclusive("f_number", "aperture_radius")
        options.exclusive("camera", "camera_position")
        options.exclusive("camera", "camera_target")
        options.count("width", 1)
        options.count("height", 1)
        options.text("environment")
        options.text("camera")
        for key, limits in NUMBERS.items():
            options.number(key, 1.0, limits)
        for key in ("camera_position", "camera_target"):
            options.vector(key, (0.0, 0.0, 0.0))


class _Options(Table):
    """A table whose keys are command-line options."""

    def place(self, key: str) -> str:
        """The command-line option for `key`."""
        name = key.replace("_", "-")
        return f"--size ({name})" if key in ("width", "height") else f"--{name}"


NO_OVERRIDES = Overrides()


def override_camera(values: dict[str, Any], overrides: Overrides, file: str, files: SceneFiles) -> Camera:
    """The camera of the table `values` with `overrides`.

    values: as in `[camera]` of a scene file. files: the files that the table may name. Raises
    BokehguideError for errors in the table, before or after the change.
    """
    read_camera(values, file, files)
    values = dict(values)
    if overrides.camera_position is not None:
        values["position"] = list(overrides.camera_position)
    if overrides.camera_target is not None:
        values["target"] = list(overrides.camera_target)
    if overrides.fov is not None:
        if "focal_length" in values:
            width = values.setdefault("sensor_width", SENSOR_WIDTH)
            values["focal_length"] = focal_length(overrides.fov, width)
        else:
            values["fov"] = overrides.fov
    if overrides.aperture_radius is not None:
        values.pop("f_number", None)
        values["aperture_radius"] = overrides.aperture_radius
    if overrides.f_number is not None:
        values.pop("aperture_radius", None)
        values["f_number"] = overrides.f_number
        if "focal_length" not in values:
            values["focal_length"] = focal_length(values.pop("fov", Camera.fov))
    if overrides.focus_distance is not None:
        values.pop("focus_point", None)
        values["focus_distance"] = overrides.focus_distance
    return read_camera(values, file, files)


def override_surroundings(scene: Scene, overrides: Overrides) -> Scene:
    """`scene` with the film size and the radiance of the environment from `overrides`.

    The environment keeps its `rotation` and `visible`, but not its intensity.
    """
    film = replace(scene.film, width=overrides.width or scene.film.width, height=overrides.height or scene.film.height)
    scene = replace(scene, film=film)
    if overrides.environment is None:
        return scene
    radiance, warnings = read_radiance(overrides.environment)
    environment = replace(scene.environment or Environment(radiance), radiance=radiance)
    return replace(scene, environment=environment, warnings=scene.warnings + tuple(warnings))


def read_radiance(text: str) -> tuple[np.ndarray, list[str]]:
    """The radiance `[H, W, 3]` from "R,G,B" or from the path of a map, and warnings."""
    parts = text.split(",")
    try:
        color = [float(part) for part in parts]
    except ValueError:
        if len(parts) == 3 and Path(text).suffix.lower() not in (".hdr", ".exr"):
            raise BokehguideError(f"--environment: {text!r} is not three numbers R,G,B") from None
        return load_environment_map(Path(text))
    if len(color) != 3 or not all(NOT_NEGATIVE.contains(channel) for channel in color):
        raise BokehguideError(f"--environment: {text!r}; give R,G,B, each {NOT_NEGATIVE.remedy}")
    return constant_radiance(color), []
