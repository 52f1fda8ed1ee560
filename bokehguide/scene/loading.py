"""Scenes by name: built-in scenes, scene files and models."""

from __future__ import annotations

import difflib
from dataclasses import asdict, replace
from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.scene.builtin import BUILTIN
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.focusing import focused
from bokehguide.scene.likely_mistakes import likely_mistakes
from bokehguide.scene.model_files import refuse_format
from bokehguide.scene.overrides import NO_OVERRIDES, Overrides, override_camera, override_environment, override_film
from bokehguide.scene.types import Scene
from bokehguide.scene.validation import checked

MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")


def load_scene(spec: str, overrides: Overrides = NO_OVERRIDES, allow_outside: bool = False) -> Scene:
    """The scene that `spec` names, ready to render.

    spec: the name of a built-in scene, the path of a `.toml` scene file, or the path of a model. A
    model without a camera gets one that frames it; a model without lights gets a sky.
    overrides: replace the scene's own values. allow_outside: permits paths that leave the file's folder.
    The scene's `likely_mistakes` say what the user may not have meant.

    Raises BokehguideError for input that is missing, malformed or out of range.
    """
    suffix = Path(spec).suffix.lower()
    if overrides.camera is not None and suffix not in MODEL_SUFFIXES:
        raise BokehguideError(f"--camera: {overrides.camera!r}: selects a camera of a model, but {spec} is none; leave it out")
    files = SceneFiles(Path(spec).parent, allow_outside)
    if spec in BUILTIN:
        scene = override_environment(BUILTIN[spec](), overrides)
        chosen = override_camera(asdict(scene.camera), overrides, scene.name, files)
    elif suffix == ".toml":
        from bokehguide.scene.toml.scene_file import read_scene_file

        scene, chosen = read_scene_file(Path(spec), overrides, files)
        scene = override_environment(scene, overrides)
    elif suffix in MODEL_SUFFIXES:
        from bokehguide.scene.framing import model_scene

        scene, chosen = model_scene(Path(spec), overrides, files)
    else:
        refuse_format(Path(spec), spec)
        near = difflib.get_close_matches(spec, BUILTIN, n=1)
        raise BokehguideError(
            f"{spec}: no such scene" + (f"; did you mean {near[0]!r}?" if near else "") + "\n"
            f"Give a built-in name ({', '.join(BUILTIN)}), a .toml scene file, "
            f"or a model ({' '.join(MODEL_SUFFIXES)})"
        )
    scene = checked(replace(scene, camera=chosen.camera, film=override_film(scene.film, overrides)), spec)
    if chosen.focus is not None:
        scene = focused(scene, chosen.focus)
    return replace(scene, likely_mistakes=likely_mistakes(scene, chosen.written))
