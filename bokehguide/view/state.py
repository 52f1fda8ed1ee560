"""The values that the page sets, and the command line and the scene file that make the same picture."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.limits import FARTHEST_FOCUS, VIEWS
from bokehguide.scene import BUILTIN, Aperture, Overrides, Scene
from bokehguide.scene.cameras import focal_length
from bokehguide.scene.loading import base_of, override_scene
from bokehguide.scene.model_files import MODEL_SUFFIXES
from bokehguide.scene.overrides import APERTURE, NO_OVERRIDES, option_word
from bokehguide.scene.tables import ANGLE_OF_VIEW, EXPOSURE, Table, did_you_mean
from bokehguide.scene.toml.derived import derived_text
from bokehguide.scene.types import Vector
from bokehguide.train import MODES

LAYERS = ("picture", "depth", "normal", "albedo", "variance", "beta", "emitters")
"""Layers of the picture that the page can show; the last two exist in modes that learn."""
WORLD_UP = (0.0, 1.0, 0.0)
MAX_SPP = 2**20
OPENING = ("f_number", "aperture_radius", "fov")
"""Overrides that give the radius of the lens together."""
LOADED = ("environment", "camera", "focus_at", "focus_on")
"""Overrides whose effect is in the scene since it was loaded."""


@dataclass(frozen=True)
class ViewState:
    """Everything on which the picture of the page depends.

    overrides: of the scene, as on the command line. mode, spp, seed: as of `RenderSettings`. exposure: EV, None to meter; view:
    display transform. denoise: whether the denoised picture is shown. layer: a name in LAYERS.
    """

    overrides: Overrides
    mode: str = "guided"
    spp: int = 64
    seed: int = 0
    exposure: float | None = None
    view: str = VIEWS[0]
    denoise: bool = False
    layer: str = LAYERS[0]

    @property
    def traced(self) -> tuple[object, ...]:
        """The values that need new samples when they change; the others change only how samples are shown."""
        return self.overrides, self.mode, self.seed, self.denoise


@dataclass(frozen=True)
class Source:
    """The scene as it was loaded.

    scene: with the `overrides` of the command line. spec: its name or path; empty for a `Scene` of Python. base, chosen: the
    scene that the `base` of a scene file leads to, and all overrides of that scene.
    """

    scene: Scene
    overrides: Overrides = NO_OVERRIDES
    spec: str = ""
    allow_outside: bool = False
    base: str = field(init=False)
    chosen: Overrides = field(init=False)

    def __post_init__(self) -> None:
        base, chosen = base_of(self.spec, self.overrides, self.allow_outside)
        object.__setattr__(self, "base", base)  # the dataclass is frozen
        object.__setattr__(self, "chosen", chosen)

    @property
    def is_model(self) -> bool:
        """Whether the scene is a model file, or a scene file whose base is one."""
        return Path(self.base).suffix.lower() in MODEL_SUFFIXES

    def scene_of(self, overrides: Overrides) -> Scene:
        """The scene that `load_scene(spec, overrides)` returns; meshes and materials are those of `scene`.

        overrides: as of `changed` and `moved`. Raises BokehguideError for values out of range.
        """
        if overrides == self.overrides:
            return self.scene
        given, scene = overrides.given, self.scene
        left_out = LOADED
        if all(getattr(overrides, key) == getattr(self.overrides, key) for key in OPENING):
            left_out = (*LOADED, *OPENING)  # an f-number without a field of view counts with the focal length of a scene file
        if self.is_model and overrides.camera_position is not None:  # such a model has no other key of its own camera
            scene = replace(scene, camera=replace(scene.camera, up=WORLD_UP))
        return override_scene(scene, Overrides(**{key: value for key, value in given.items() if key not in left_out}))


def changed(state: ViewState, source: Source, name: str, value: Any) -> ViewState:
    """The state with another value.

    name: of a field of `ViewState`, of the lens or of the environment (see CHANGES). Raises BokehguideError for an unknown name
    and for a value out of range.
    """
    if name not in CHANGES:
        raise BokehguideError(f"{name}: no such value; {did_you_mean(name, CHANGES)}")
    new = _without_sensor(CHANGES[name](state, source, value), source)
    if new.overrides != state.overrides:
        source.scene_of(new.overrides)  # raises for values out of range
    return new


def with_overrides(state: ViewState, **values: Any) -> ViewState:
    """The state with other overrides, which replace contradicting ones; None removes an override."""
    removed = [key for key, value in values.items() if value is None]
    kept = {key: value for key, value in state.overrides.given.items() if key not in removed}
    given = {key: value for key, value in values.items() if value is not None}
    return replace(state, overrides=Overrides(**given).over(Overrides(**kept)))


def moved(state: ViewState, source: Source, position: Vector, target: Vector) -> ViewState:
    """The state with a camera at another place, which keeps its lens and its focus distance.

    All values of the camera become explicit, as those of a scene file may depend on its position. So does the rotation of a
    model's environment, which may turn with the camera that frames the model. Raises BokehguideError as `changed`.
    """
    scene = source.scene_of(state.overrides)
    camera, values = scene.camera, {}
    if source.is_model and scene.environment is not None:
        values["environment_rotation"] = scene.environment.rotation
    if state.overrides.f_number is None:
        values["aperture_radius"] = camera.aperture_radius
    new = with_overrides(
        state, camera_position=position, camera_target=target, fov=camera.fov, focus_distance=camera.focus_distance, **values
    )
    new = _without_sensor(new, source)
    source.scene_of(new.overrides)
    return new


def _without_sensor(state: ViewState, source: Source) -> ViewState:
    """The state with a radius for an f-number that would count with another sensor.

    A camera that `--camera` selects has a sensor of its own. Once such a camera moves, a command gives the sensor of the model's
    first camera.
    """
    own = source.chosen.camera
    if own is None or state.overrides.f_number is None or state.overrides.over(source.chosen).camera is not None:
        return state
    return with_overrides(state, aperture_radius=source.scene_of(state.overrides).camera.aperture_radius)


def _number(value: Any, name: str) -> float:
    """A finite number or infinity."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != value:
        raise BokehguideError(f"{name}: {str(value)[:40]!r} is no number")
    return float(value)


def _set_f_number(state: ViewState, source: Source, value: Any) -> ViewState:
    """An f-number; infinity or None is a pinhole. The field of view becomes explicit, so that both give one radius."""
    camera = source.scene_of(state.overrides).camera
    if value is None or _number(value, "f-number") == math.inf:
        return _without_shape(with_overrides(state, aperture_radius=0.0, fov=camera.fov))
    return with_overrides(state, f_number=_number(value, "f-number"), fov=camera.fov)


def _without_shape(state: ViewState) -> ViewState:
    """The state without overrides of the aperture's shape, which a pinhole has not."""
    return with_overrides(state, **dict.fromkeys(APERTURE.values()))


def _set_focus(state: ViewState, source: Source, value: Any) -> ViewState:
    """Metres; None is infinity."""
    return with_overrides(state, focus_distance=math.inf if value is None else _number(value, "focus distance"))


def _set_fov(state: ViewState, source: Source, value: Any) -> ViewState:
    """Degrees. The f-number stays, and so does the focus: a model's camera focuses on the middle of its field of view.

    The place becomes explicit for a model, as the camera that frames a model stands where its field of view fits.
    """
    camera = source.scene_of(state.overrides).camera
    if source.is_model and camera.up == WORLD_UP:
        state = moved(state, source, camera.position, camera.target)
    f_number = state.overrides.f_number or camera.f_number  # a given number stays as it was typed
    opening = {"aperture_radius": 0.0} if camera.aperture_radius == 0.0 else {"f_number": f_number}
    return with_overrides(state, fov=_number(value, "field of view"), focus_distance=camera.focus_distance, **opening)


def _set_focal_length(state: ViewState, source: Source, value: Any) -> ViewState:
    length, width = _number(value, "focal length"), source.scene_of(state.overrides).camera.sensor_width
    low, high = (focal_length(angle, width) for angle in (ANGLE_OF_VIEW.high, ANGLE_OF_VIEW.low))
    if not low <= length <= high:
        raise BokehguideError(f"focal length: {length:g} is out of range; give millimetres from {low:.3g} to {high:.3g}")
    return _set_fov(state, source, float(np.degrees(2.0 * np.arctan(width / (2.0 * length)))))


def _shape(key: str) -> Callable[[ViewState, Source, Any], ViewState]:
    """A change of one value of the aperture's shape."""

    def change(state: ViewState, source: Source, value: Any) -> ViewState:
        values: dict[str, Any] = {f"aperture_{key}": _number(value, key)}
        if key == "blades":
            values = {"aperture_blades": value, "aperture_image": None}  # `read_aperture` checks the number
            if value == 0:  # rotation and curvature have no effect without blades, which would be an error
                values |= {"aperture_rotation": None, "aperture_curvature": None}
        return with_overrides(state, **values)

    return change


def _set_rotation(state: ViewState, source: Source, value: Any) -> ViewState:
    return with_overrides(state, environment_rotation=_number(value, "environment rotation"))


def _set_exposure(state: ViewState, source: Source, value: Any) -> ViewState:
    if value is None:
        return replace(state, exposure=None)
    return replace(state, exposure=Table({"exposure": value}, "page", "", ("exposure",)).number("exposure", None, EXPOSURE))


def _set_spp(state: ViewState, source: Source, value: Any) -> ViewState:
    if type(value) is not int or not 1 <= value <= MAX_SPP:
        raise BokehguideError(f"SPP: {str(value)[:40]!r} is out of range; give a whole number from 1 to {MAX_SPP}")
    return replace(state, spp=value)


def _choice(name: str, known: Mapping[str, Any] | tuple[Any, ...]) -> Callable[[ViewState, Source, Any], ViewState]:
    """A change of a field that has one of some values."""

    def change(state: ViewState, source: Source, value: Any) -> ViewState:
        if not isinstance(value, (str, bool)) or value not in known:
            raise BokehguideError(f"{name}: {str(value)[:40]!r} is unknown; choose one of {', '.join(map(str, known))}")
        return replace(state, **{name: value})

    return change


CHANGES: dict[str, Callable[[ViewState, Source, Any], ViewState]] = {
    "f_number": _set_f_number,
    "focus_distance": _set_focus,
    "fov": _set_fov,
    "focal_length": _set_focal_length,
    "environment_rotation": _set_rotation,
    "exposure": _set_exposure,
    "spp": _set_spp,
    "mode": _choice("mode", MODES),
    "view": _choice("view", VIEWS),
    "denoise": _choice("denoise", (True, False)),
    "layer": _choice("layer", LAYERS),
    **{key: _shape(key) for key in APERTURE if key != "image"},
}
"""Functions that change one value, by its name on the page."""


def values_of(state: ViewState, source: Source) -> dict[str, Any]:
    """The values of all controls. None: a pinhole's f-number, infinite focus, a metered exposure, no environment."""
    scene = source.scene_of(state.overrides)
    camera, environment = scene.camera, scene.environment
    shape = camera.aperture or Aperture()
    return {
        "f_number": None if camera.aperture_radius == 0.0 else camera.f_number,
        "focus_distance": camera.focus_distance if camera.focus_distance < FARTHEST_FOCUS else None,
        "fov": camera.fov,
        "focal_length": focal_length(camera.fov, camera.sensor_width),
        **{key: getattr(shape, key) for key in APERTURE if key != "image"},
        "has_mask": shape.image is not None,
        "environment_rotation": None if environment is None else environment.rotation,
        "position": camera.position,
        "target": camera.target,
        "exposure": state.exposure,
        **{name: getattr(state, name) for name in ("spp", "mode", "view", "denoise", "layer")},
    }


def command_line(state: ViewState, source: Source, spp: int | None = None) -> str:
    """The command that renders this picture, with `spp` samples per pixel instead of the state's where given."""
    options = {"mode": state.mode, "spp": spp or state.spp, "seed": state.seed} | _display_options(state, source)
    words = ["bokehguide", "render", source.spec or source.scene.name, *(option_word(*option) for option in options.items())]
    words += state.overrides.option_words()
    return shlex.join(words + ["--denoise"] * state.denoise + ["--allow-outside"] * source.allow_outside)


def scene_file(state: ViewState, source: Source, folder: Path, name: str) -> str:
    """The text of a scene file `name` in `folder` that makes this picture; its first lines hold the command.

    Raises BokehguideError for a scene of Python, which has no file.
    """
    if not source.spec:
        raise BokehguideError(f"{source.scene.name}: a scene file cannot name a scene of Python; save the picture instead")
    values, outside = dict(state.overrides.given), source.allow_outside
    base = source.spec
    if base not in BUILTIN:
        base, outside = _relative(base, folder, outside)
    for key in ("environment", "aperture_image"):
        path = values.get(key)
        if path is not None and Path(path).is_file():
            values[key], outside = _relative(path, folder, outside)
    options = {"mode": state.mode, "spp": state.spp, "seed": state.seed} | _display_options(state, source)
    words = [name, *(f"--{key}={value}" for key, value in options.items())]
    comment = shlex.join(["bokehguide", "render", *words] + ["--denoise"] * state.denoise + ["--allow-outside"] * outside)
    return derived_text(base, Overrides(**values), _exposure(state, source), comment)


def _exposure(state: ViewState, source: Source) -> float | str | None:
    """The exposure as an option or a key; None for a metered one, unless the scene has another one."""
    return "auto" if state.exposure is None and source.scene.film.exposure is not None else state.exposure


def _display_options(state: ViewState, source: Source) -> dict[str, Any]:
    """The options of view and exposure."""
    exposure = _exposure(state, source)
    return {"view": state.view} | ({} if exposure is None else {"exposure": exposure})


def _relative(path: str, folder: Path, outside: bool) -> tuple[str, bool]:
    """The path relative to a folder, and whether this path or an earlier one leaves it."""
    relative = os.path.relpath(path, folder)
    return relative, outside or relative.startswith("..")
