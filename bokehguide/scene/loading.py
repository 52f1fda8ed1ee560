"""Scenes by name: built-in scenes, scene files and models."""

from __future__ import annotations

import difflib
import logging
import os
from dataclasses import asdict, replace
from pathlib import Path

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.builtin import BUILTIN
from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.overrides import NO_OVERRIDES, Overrides, override_camera, override_surroundings
from bokehguide.scene.types import Scene
from bokehguide.scene.validation import checked

log = logging.getLogger(__name__)

MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")


def load_scene(spec: Scene | str | os.PathLike[str], overrides: Overrides = NO_OVERRIDES, allow_outside: bool = False) -> Scene:
    """The scene that `spec` names, ready to render.

    spec: the name of a built-in scene, the path of a `.toml` scene file, the path of a model, or a scene itself. A
    model without a camera gets one that frames it; a model without lights gets a sky.
    overrides: replace the scene's own values. allow_outside: permits paths that leave the file's folder.

    Raises BokehguideError for input that is missing, malformed or out of range.
    """
    name = spec.name if isinstance(spec, Scene) else os.fspath(spec)
    suffix = "" if isinstance(spec, Scene) else Path(spec).suffix.lower()
    if overrides.camera is not None and suffix not in MODEL_SUFFIXES:
        raise BokehguideError(f"--camera: {overrides.camera!r}: selects a camera of a model, but {name} is none; leave it out")
    log.info("loading %s", printable(name, 120))
    files = SceneFiles(Path() if isinstance(spec, Scene) else Path(spec).parent, allow_outside)
    with located(name):
        scene = _with_camera(spec, overrides, files) if isinstance(spec, Scene) else _read(name, suffix, overrides, files)
        return checked(override_surroundings(scene, overrides), name)


def _with_camera(scene: Scene, overrides: Overrides, files: SceneFiles) -> Scene:
    """`scene` with the camera of `overrides`, and the aperture's shape as it was."""
    values = asdict(replace(scene.camera, aperture=None))
    camera = override_camera(values, overrides, scene.name, files)
    return replace(scene, camera=replace(camera, aperture=scene.camera.aperture))


def _read(spec: str, suffix: str, overrides: Overrides, files: SceneFiles) -> Scene:
    """The scene that `spec` names, with the camera of `overrides`."""
    if spec in BUILTIN:
        return _with_camera(BUILTIN[spec](), overrides, files)
    if suffix == ".toml":
        from bokehguide.scene.toml.scene_file import read_scene_file

        return read_scene_file(Path(spec), overrides, files)
    if suffix in MODEL_SUFFIXES:
        from bokehguide.scene.framing import model_scene

        return model_scene(Path(spec), overrides, files)
    near = difflib.get_close_matches(spec, BUILTIN, n=1)
    raise BokehguideError(
        f"{spec}: no such scene" + (f"; did you mean {near[0]!r}?" if near else "") + "\n"
        f"Give a built-in name ({', '.join(BUILTIN)}), a .toml scene file, "
        f"or a model ({' '.join(MODEL_SUFFIXES)})"
    )
