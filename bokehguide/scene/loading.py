"""Scenes by name: built-in scenes, scene files and models."""

from __future__ import annotations

import difflib
import logging
import os
import shlex
from dataclasses import asdict, replace
from pathlib import Path

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.apertures import aperture_table
from bokehguide.scene.builtin import BUILTIN
from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles, is_file
from bokehguide.scene.focusing import focused
from bokehguide.scene.likely_mistakes import likely_mistakes
from bokehguide.scene.model_files import MODEL_SUFFIXES, refuse_format
from bokehguide.scene.overrides import (
    APERTURE,
    NO_OVERRIDES,
    ChosenCamera,
    Overrides,
    override_camera,
    override_environment,
    override_film,
)
from bokehguide.scene.tables import override_place, shown
from bokehguide.scene.toml.derived import read_derived
from bokehguide.scene.types import Scene
from bokehguide.scene.validation import checked

log = logging.getLogger(__name__)

MAX_BASES = 8
"""Scene files with a `base` that may lead to each other; a cycle has more."""
MODEL_OVERRIDES = ("camera", "variant", "time")
"""Overrides that make sense for a model alone."""
NO_SCENES = {
    ".exr": "is a picture, and no scene; `bokehguide develop {0}` makes a PNG of it",
    ".hdr": "is an environment map, and no scene; give a scene or a model, with --environment {0}",
    ".ckpt": "is a checkpoint, and no scene; give the scene of its render, with --out {1} --resume",
}
"""Description and remedy by suffix of a file. {0} is the path of the file, and {1} is the path with the suffix .exr."""


def load_scene(spec: Scene | str | os.PathLike[str], overrides: Overrides = NO_OVERRIDES, allow_outside: bool = False) -> Scene:
    """The scene that `spec` names, ready to render.

    spec: the name of a built-in scene, the path of a `.toml` scene file, of a Mitsuba `.xml` or a pbrt `.pbrt` file, the
    path of a model, or a scene itself. A model without a camera gets one that frames it; a model without lights gets a sky.
    overrides: replace the scene's own values. allow_outside: permits paths that leave the file's folder.
    The scene's `likely_mistakes` say what the user may not have meant.

    Raises BokehguideError for input that is missing, malformed or out of range.
    """
    if not isinstance(spec, (Scene, str, os.PathLike)):
        raise BokehguideError(
            f"scene: {shown(spec)} is no scene; give a Scene, the name of a built-in scene, or the path of a file"
        )
    if not isinstance(overrides, Overrides):
        raise BokehguideError(f"overrides: {shown(overrides)} is no Overrides; give Overrides(…)")
    name = spec.name if isinstance(spec, Scene) else os.fspath(spec)
    suffix = "" if isinstance(spec, Scene) else Path(spec).suffix.lower()
    _check_model(name, suffix, overrides)
    log.info("loading %s", printable(name, 120))
    files = SceneFiles(Path() if isinstance(spec, Scene) else Path(spec).parent, allow_outside)
    with located(name):
        if isinstance(spec, Scene):
            fresh = replace(spec, likely_mistakes=())
            scene, chosen = _with_camera(override_environment(fresh, overrides), overrides, files)
        else:
            scene, chosen = _read(name, overrides, files)
        scene = checked(replace(scene, camera=chosen.camera, film=override_film(scene.film, overrides)), name)
        if chosen.focus is not None:
            scene = focused(scene, chosen.focus)
        mistakes = (*scene.likely_mistakes, *likely_mistakes(scene, chosen.written))
        return replace(scene, likely_mistakes=mistakes, files=scene.files | _files_read(spec, overrides, files))


def _files_read(spec: Scene | str | os.PathLike[str], overrides: Overrides, files: SceneFiles) -> frozenset[Path]:
    """Resolved paths of the scene's own file, of files in `overrides`, and of all files that were found on the way."""
    named = [each for each in (spec, overrides.environment, overrides.aperture_image) if isinstance(each, (str, os.PathLike))]
    paths = files.found.union(Path(each).resolve() for each in named if is_file(each))
    return frozenset(path for path in paths if is_file(path))


def base_of(spec: str, overrides: Overrides = NO_OVERRIDES, allow_outside: bool = False) -> tuple[str, Overrides]:
    """The scene that the `base` of a scene file leads to, and `overrides` over those of the files on the way.

    spec, overrides, allow_outside: as of `load_scene`; another scene than a file with a `base` is its own base.
    """
    from bokehguide.scene.toml.scene_file import parse_scene_file

    files = SceneFiles(Path(spec).parent, allow_outside)
    for _ in range(MAX_BASES + 1):
        if spec in BUILTIN or Path(spec).suffix.lower() != ".toml":
            break
        tables = parse_scene_file(Path(spec), files)
        if "base" not in tables:
            break
        derived = read_derived(Path(spec), tables, files)
        spec, overrides = derived.base, overrides.over(derived.overrides)
    return spec, overrides


def override_scene(scene: Scene, overrides: Overrides) -> Scene:
    """`scene` with a camera, a film and an environment by `overrides`, except the focus on a point or an object.

    Meshes and materials are the same objects. Raises BokehguideError for a value out of range.
    """
    scene, chosen = _with_camera(override_environment(scene, overrides), overrides, SceneFiles(Path(), True))
    return replace(scene, camera=chosen.camera, film=override_film(scene.film, overrides))


def _with_camera(scene: Scene, overrides: Overrides, files: SceneFiles) -> tuple[Scene, ChosenCamera]:
    """`scene`, and its camera with `overrides`."""
    own = scene.camera.aperture
    values = asdict(replace(scene.camera, aperture=None))
    reshaped = any(name in overrides.given for name in APERTURE.values())
    if own is not None and reshaped:
        values["aperture"] = aperture_table(own)
    chosen = override_camera(values, overrides, scene.name, files)
    return scene, chosen if reshaped else replace(chosen, camera=replace(chosen.camera, aperture=own))


def _check_model(name: str, suffix: str, overrides: Overrides) -> None:
    """Raise BokehguideError if `overrides` select a part of a model in a scene that is no model."""
    for key in MODEL_OVERRIDES:
        value = getattr(overrides, key)
        if value is not None and suffix not in (*MODEL_SUFFIXES, ".toml"):
            raise BokehguideError(
                f"{override_place(key)}: {value!r}: selects a {key} of a model, but {name} is none; leave it out"
            )


def _read(spec: str, overrides: Overrides, files: SceneFiles, depth: int = 0, lit: bool = False) -> tuple[Scene, ChosenCamera]:
    """The scene that `spec` names, and its camera with `overrides`.

    depth: number of files that lead here by their `base`. lit: whether one of these files adds lights.
    """
    suffix = Path(spec).suffix.lower()
    if spec in BUILTIN:
        _check_model(spec, "", overrides)
        return _with_camera(override_environment(BUILTIN[spec](), overrides), overrides, files)
    if suffix == ".toml":
        return _read_toml(Path(spec), overrides, files, depth, lit)
    if suffix == ".xml":
        from bokehguide.scene.mitsuba_xml import read_mitsuba

        _check_model(spec, "", overrides)
        scene, chosen = read_mitsuba(Path(spec), overrides, files)
        return override_environment(scene, overrides), chosen
    if spec.lower().endswith((".pbrt", ".pbrt.gz")):
        from bokehguide.scene.pbrt import read_pbrt

        _check_model(spec, "", overrides)
        scene, chosen = read_pbrt(Path(spec), overrides, files)
        return override_environment(scene, overrides), chosen
    if suffix in MODEL_SUFFIXES:
        from bokehguide.scene.framing import model_scene

        return model_scene(Path(spec), overrides, files, lit)
    refuse_format(Path(spec), spec)
    if suffix in NO_SCENES:
        paths = (shlex.quote(str(path)) for path in (spec, Path(spec).with_suffix(".exr")))
        raise BokehguideError(f"{spec}: {NO_SCENES[suffix].format(*paths)}")
    near = difflib.get_close_matches(spec, BUILTIN, n=1)
    problem = "exists, and is no scene of a known kind" if Path(spec).exists() else "no such scene"
    raise BokehguideError(
        f"{spec}: {problem}" + (f"; did you mean {near[0]!r}?" if near else "") + "\n"
        f"Give a built-in name ({', '.join(BUILTIN)}), a .toml scene file, a Mitsuba .xml or a pbrt .pbrt file, "
        f"or a model ({' '.join(MODEL_SUFFIXES)})"
    )


def _read_toml(path: Path, overrides: Overrides, files: SceneFiles, depth: int, lit: bool) -> tuple[Scene, ChosenCamera]:
    """The scene of a `.toml` file, and its camera with `overrides`. depth, lit: as of `_read`."""
    from bokehguide.scene.toml.scene_file import parse_scene_file, read_scene_file

    tables = parse_scene_file(path, files)
    if "base" not in tables:
        _check_model(str(path), "", overrides)
        scene, chosen = read_scene_file(path, tables, overrides, files)
        return override_environment(scene, overrides), chosen
    derived = read_derived(path, tables, files)
    if depth >= MAX_BASES:
        raise BokehguideError(f"{path}: base: more than {MAX_BASES} files lead to each other; give the first one's base")
    merged = overrides.over(derived.overrides)
    scene, chosen = _read(str(derived.base), merged, files, depth + 1, lit or derived.lit)
    film = replace(override_film(scene.film, merged), **derived.film)
    return derived.with_lights(replace(scene, name=path.stem, film=film), merged.hide_environment), chosen
