"""Overrides: scene values that the command line replaces."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.apertures import KEYS as APERTURE_KEYS
from bokehguide.scene.cameras import FOCUS_KEYS, Focus, read_camera, read_focus
from bokehguide.scene.checks import plain
from bokehguide.scene.environments import constant_radiance, load_environment_map
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.model import ModelState
from bokehguide.scene.tables import ANGLE_OF_VIEW, ANY, IN_FRONT, NOT_NEGATIVE, POSITIVE, Table, is_number, override_place
from bokehguide.scene.types import Camera, Environment, FilmSettings, Scene, Vector

NUMBERS = {
    "f_number": POSITIVE,
    "aperture_radius": NOT_NEGATIVE,
    "focus_distance": IN_FRONT,
    "fov": ANGLE_OF_VIEW,
    "environment_rotation": ANY,
}
RIVALS = (
    ("f_number", "aperture_radius"),
    ("focus_distance", "focus_at", "focus_on"),
    ("camera", "camera_position"),
    ("camera", "camera_target"),
)
"""Overrides of which one at most is given."""
NO_ENVIRONMENT = "none"
"""The value of the override `environment` that removes the environment."""
APERTURE = {key: f"aperture_{key}" for key in APERTURE_KEYS}
"""Overrides of single keys of the table `[camera.aperture]`; `read_aperture` checks them."""


@dataclass(frozen=True)
class Overrides:
    """Values that replace a scene's own; None keeps the scene's.

    width, height: pixels. max_depth: largest number of segments of a path. environment: the path of a `.hdr` or `.exr` map, a
    radiance "R,G,B" or three numbers, or "none" for no environment. environment_rotation: of the map, degrees about +y,
    anticlockwise seen from above. hide_environment: if True, the camera sees neither map nor suns, and their light stays.
    f_number: focal length / lens diameter, with the focal length of the field of view on the scene's
    sensor, 36 mm wide by default. aperture_radius, focus_distance, camera_position, camera_target:
    metres. focus_at: focuses on the surface at a point of the frame, in pixels from the top left
    corner, or in fractions of the frame if both are at most 1. focus_on: focuses on the visible part
    of an object, glTF node or material of this name. fov: horizontal, degrees; a scene with an
    f-number keeps it. camera: name or number of a model's camera, or "frame" for a camera that frames
    the model. variant: name of a material variant of a glTF model, or SET=NAME,… of a USD stage. time: of the animations of a
    glTF or USD model, in seconds.
    aperture_blades, aperture_rotation, aperture_curvature, aperture_ratio, aperture_cat_eye,
    aperture_edge, aperture_image: single fields of `Aperture`; the image is a path.
    NumPy numbers and arrays, lists and paths become numbers, tuples and texts, and so do a radiance and the number of a camera.

    Raises BokehguideError, naming the field and the command-line option, for a value out of range.
    """

    width: int | None = None
    height: int | None = None
    max_depth: int | None = None
    environment: str | Vector | None = None
    environment_rotation: float | None = None
    hide_environment: bool | None = None
    f_number: float | None = None
    aperture_radius: float | None = None
    focus_distance: float | None = None
    focus_at: tuple[float, float] | None = None
    focus_on: str | None = None
    camera_position: Vector | None = None
    camera_target: Vector | None = None
    fov: float | None = None
    camera: str | int | None = None
    variant: str | None = None
    time: float | None = None
    aperture_blades: int | None = None
    aperture_rotation: float | None = None
    aperture_curvature: float | None = None
    aperture_ratio: float | None = None
    aperture_cat_eye: float | None = None
    aperture_edge: float | None = None
    aperture_image: str | None = None

    def __post_init__(self) -> None:
        for key, value in self.given.items():
            object.__setattr__(self, key, _as_option(key, value))  # the dataclass is frozen
        options = self._options()
        for names in RIVALS:
            options.exclusive(*names)
        options.count("width", 1)
        options.count("height", 1)
        options.count("max_depth", 1)
        if not isinstance(self.environment, str | None):
            kind = type(self.environment).__name__
            remedy = f'give three numbers, or the path of a .hdr or .exr map, or "{NO_ENVIRONMENT}"'
            raise BokehguideError(f"{options.place('environment')}: {kind} is no radiance; {remedy}")
        options.text("environment")
        if not options.flag("hide_environment"):
            object.__setattr__(self, "hide_environment", None)
        options.text("camera")
        options.text("variant")
        options.number("time", 0.0)
        for key, limits in NUMBERS.items():
            options.number(key, 1.0, limits)
        for key in ("camera_position", "camera_target"):
            options.vector(key, (0.0, 0.0, 0.0))
        read_focus(options)

    @property
    def given(self) -> dict[str, Any]:
        """The values that are not None, by name."""
        return {key: value for key, value in vars(self).items() if value is not None}

    @property
    def state(self) -> ModelState:
        """The state of a model that `variant` and `time` ask for."""
        return ModelState(self.variant, self.time)

    @property
    def focus(self) -> Focus | None:
        """What `focus_at` or `focus_on` ask for, None without either."""
        return read_focus(self._options())

    def over(self, other: Overrides) -> Overrides:
        """These overrides, and the values of `other` that do not contradict them."""
        rivals = {rival for names in RIVALS for name in names if name in self.given for rival in names}
        return Overrides(**{key: value for key, value in other.given.items() if key not in rivals} | self.given)

    def option_words(self) -> list[str]:
        """The values as words of the command line."""
        given = {key: value for key, value in self.given.items() if key not in ("width", "height")}
        size = {"size": f"{self.width}x{self.height}"} if self.width and self.height else {}
        return [option_word(key, value) for key, value in (size | given).items()]

    def _options(self) -> _Options:
        return _Options(self.given, "", "", vars(self))


class _Options(Table):
    """A table whose keys are fields of `Overrides` and command-line options."""

    def place(self, key: str) -> str:
        """The field, and the command-line option for it."""
        return f"{key} or --size ({key})" if key in ("width", "height") else override_place(key)


def _as_option(key: str, value: Any) -> Any:
    """NumPy numbers and arrays, lists and paths as numbers, tuples and texts; a radiance and the number of a camera as texts."""
    value = plain(os.fspath(value) if isinstance(value, os.PathLike) else value)
    value = tuple(value) if isinstance(value, list) else value
    numbers = isinstance(value, tuple) and all(map(is_number, value))
    return option_text(value) if (key == "environment" and numbers) or (key == "camera" and type(value) is int) else value


def option_word(name: str, value: Any) -> str:
    """A command-line option with its value as one word. name: of the option, with underscores. True: an option without value."""
    option = f"--{name.replace('_', '-')}"
    return option if value is True else f"{option}={option_text(value)}"


def option_text(value: Any) -> str:
    """A value as the text of a command-line option."""
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


NO_OVERRIDES = Overrides()

OVERRIDES = tuple(field.name for field in fields(Overrides) if field.name not in ("width", "height"))
"""Names of the overrides, except the size of the film."""


@dataclass(frozen=True)
class ChosenCamera:
    """A camera whose focus may depend on the scene. focus: what it focuses on once the scene is there, None for its focus
    distance. written: keys of the camera that the user wrote, in a scene file or as overrides."""

    camera: Camera
    focus: Focus | None
    written: frozenset[str]


def override_camera(
    values: dict[str, Any], overrides: Overrides, file: str, files: SceneFiles, written: bool = False
) -> ChosenCamera:
    """The camera of the table `values` with `overrides`.

    values: as in `[camera]` of a scene file. files: the files that the table may name. written: whether the user wrote the
    table. Raises BokehguideError for errors in the table, before or after the change.
    """
    read_camera(values, file, files)
    keys = frozenset(overrides.given) | (frozenset(values) if written else frozenset())
    values = dict(values)
    if overrides.camera_position is not None:
        values["position"] = list(overrides.camera_position)
    if overrides.camera_target is not None:
        values["target"] = list(overrides.camera_target)
    if overrides.fov is not None:
        values.pop("focal_length", None)
        values["fov"] = overrides.fov
    if overrides.aperture_radius is not None:
        values.pop("f_number", None)
        values["aperture_radius"] = overrides.aperture_radius
    if overrides.f_number is not None:
        values.pop("aperture_radius", None)
        values["f_number"] = overrides.f_number
    focus = overrides.focus or read_focus(Table(values, file, "camera", values))
    if any(key in overrides.given for key in FOCUS_KEYS):
        values = {key: value for key, value in values.items() if key not in FOCUS_KEYS}
    if overrides.focus_distance is not None:
        values["focus_distance"], focus = overrides.focus_distance, None
    shape = {key: overrides.given[name] for key, name in APERTURE.items() if name in overrides.given}
    return ChosenCamera(read_camera(values, file, files, shape), focus, keys)


def override_film(film: FilmSettings, overrides: Overrides) -> FilmSettings:
    """`film` with the size and the length of paths from `overrides`."""
    kept = {name: getattr(overrides, name) or getattr(film, name) for name in ("width", "height", "max_depth")}
    return replace(film, **kept)


def override_environment(scene: Scene, overrides: Overrides) -> Scene:
    """`scene` with the radiance of the environment from `overrides`.

    With another radiance, the environment keeps its `rotation` and its `visible` unless `overrides` replace them, but not its
    intensity. Raises BokehguideError for a rotation of a scene without an environment.
    """
    environment, warnings = scene.environment, []
    if overrides.environment == NO_ENVIRONMENT:
        environment = None
    elif overrides.environment is not None:
        radiance, warnings = read_radiance(option_text(overrides.environment))
        environment = replace(environment or Environment(radiance), radiance=radiance)
    if overrides.environment_rotation is not None:
        if environment is None:
            remedy = "leave it out" if overrides.environment else f"give {override_place('environment')} too"
            raise BokehguideError(
                f"{override_place('environment_rotation')}: {overrides.environment_rotation:g}: there is no environment; {remedy}"
            )
        environment = replace(environment, rotation=overrides.environment_rotation)
    if overrides.hide_environment and (environment or scene.suns):  # suns are visible without an environment
        environment = replace(environment or Environment(constant_radiance((0.0, 0.0, 0.0))), visible=False)
    if environment is scene.environment:
        return scene
    return replace(scene, environment=environment, warnings=scene.warnings + tuple(warnings))


def read_radiance(text: str) -> tuple[np.ndarray, list[str]]:
    """The radiance `[H, W, 3]` from "R,G,B" or from the path of a map, and warnings."""
    parts = text.split(",")
    try:
        color = [float(part) for part in parts]
    except ValueError:
        if Path(text).suffix.lower() not in (".hdr", ".exr"):
            kinds = f"three numbers R,G,B nor a .hdr or .exr map; give one of them, or {NO_ENVIRONMENT}"
            raise BokehguideError(f"{override_place('environment')}: {text!r} is neither {kinds}") from None
        return load_environment_map(Path(text))
    if len(color) != 3 or not all(NOT_NEGATIVE.contains(channel) for channel in color):
        raise BokehguideError(f"{override_place('environment')}: {text!r}; give R,G,B, each {NOT_NEGATIVE.remedy}")
    return constant_radiance(color), []
