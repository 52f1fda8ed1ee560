"""What a command line may change about any scene."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.cameras import SENSOR_WIDTH, focal_length, read_camera
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_environment_map
from bokehguide.scene.tables import ANGLE_OF_VIEW, IN_FRONT, NOT_NEGATIVE, POSITIVE, Table
from bokehguide.scene.types import Camera, Environment, Scene

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Overrides:
    """Values that take the place of a scene's own; None leaves the scene's.

    width, height: pixels. environment: the path of a `.hdr` or `.exr` map, or a
    radiance "R,G,B", in place of the scene's map or colour. f_number belongs to the scene's focal length or, where it has
    none, to the one that gives its field of view on a sensor 36 mm wide.
    aperture_radius, focus_distance, camera_position, camera_target: metres. fov:
    degrees, horizontal; a scene with a focal length keeps its sensor and its f-number.
    camera: which of a model's cameras, by name or number, or "frame" for one that frames it.

    Raises BokehguideError for a value out of range, naming the command line's option.
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
        options.number("f_number", None, POSITIVE)
        options.number("aperture_radius", None, NOT_NEGATIVE)
        options.number("focus_distance", None, IN_FRONT)
        options.vector("camera_position", None)
        options.vector("camera_target", None)
        options.number("fov", None, ANGLE_OF_VIEW)


class _Options(Table):
    """A table whose keys are options of the command line."""

    def place(self, key: str) -> str:
        name = key.replace("_", "-")
        return f"--size ({name})" if key in ("width", "height") else f"--{name}"


def override_camera(values: dict[str, Any], overrides: Overrides, file: str, files: SceneFiles) -> Camera:
    """The camera of the table `values` (as `[camera]` in a scene file that may read `files`) with `overrides`.

    Raises BokehguideError for what is wrong in the table itself or after the change.
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
    """`scene` with the film size and the environment's light of `overrides`.

    The scene's own `rotation` and `visible` hold for the new light; its intensity went with the old one.
    """
    film = replace(
        scene.film,
        width=overrides.width or scene.film.width,
        height=overrides.height or scene.film.height,
    )
    scene = replace(scene, film=film)
    if overrides.environment is None:
        return scene
    radiance, warnings = read_radiance(overrides.environment)
    before = scene.environment
    environment = Environment(radiance) if before is None else replace(before, radiance=radiance)
    return replace(scene, environment=environment, warnings=scene.warnings + tuple(warnings))


def read_radiance(text: str) -> tuple[np.ndarray, list[str]]:
    """An environment's light `[H, W, 3]` from "R,G,B" or from the path of a map, and any warnings."""
    parts = text.split(",")
    try:
        color = [float(part) for part in parts]
    except ValueError:
        if len(parts) == 3 and not Path(text).suffix.lower() in (".hdr", ".exr"):
            raise BokehguideError(f"--environment: {text!r} is not three numbers R,G,B") from None
        return load_environment_map(Path(text))
    if len(color) != 3 or not all(NOT_NEGATIVE.hold(channel) for channel in color):
        raise BokehguideError(f"--environment: {text!r}; give R,G,B, each {NOT_NEGATIVE.remedy}")
    return constant_radiance(color), []


def constant_radiance(color: Vector) -> np.ndarray:
    """A 1 × 1 map of one colour."""
    return np.asarray(color, dtype=np.float32).reshape(1, 1, 3)
