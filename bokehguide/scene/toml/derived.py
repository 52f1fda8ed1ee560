"""Scene files that name another scene as their `base`, override some of its values, and add lights."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from bokehguide.errors import BokehguideError
from bokehguide.scene.builtin import BUILTIN
from bokehguide.scene.checks import read_exposure
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.overrides import Overrides, override_environment
from bokehguide.scene.tables import Table
from bokehguide.scene.types import Scene

LIGHTS = ("light", "sun")
"""Tables of a whole scene that a derived scene may have too."""
KEYS = tuple(field.name for field in fields(Overrides))


@dataclass(frozen=True)
class DerivedScene:
    """A scene with overrides. base: a built-in name, or the path of a scene file or of a model. film: fields of
    `FilmSettings` that replace the base's, beside those of `overrides`. root: the tables of the file."""

    base: str
    overrides: Overrides
    film: dict[str, float | None]
    root: Table

    @property
    def lit(self) -> bool:
        """Whether the file adds lights."""
        return any(self.root.values.get(key) for key in LIGHTS)

    def with_lights(self, scene: Scene, hidden: bool | None) -> Scene:
        """`scene`, made of the base, with the lights of the file. hidden: whether the camera sees neither environment nor suns.

        Raises BokehguideError for invalid tables.
        """
        from bokehguide.scene.toml.lights import read_light_tables, read_sun_tables

        meshes, materials = read_light_tables(self.root, len(scene.materials))
        suns = (*scene.suns, *read_sun_tables(self.root))
        scene = replace(scene, meshes=(*scene.meshes, *meshes), materials=(*scene.materials, *materials), suns=suns)
        return override_environment(scene, Overrides(hide_environment=hidden))


def read_derived(path: Path, tables: dict[str, Any], files: SceneFiles) -> DerivedScene:
    """The derived scene of a `.toml` file with the given tables. Paths are relative to the file.

    files: the files that the scene may name. Raises BokehguideError naming file, field, value and remedy for invalid input.
    """
    from bokehguide.scene.toml.scene_file import SCENE_KEYS  # takes long to import, and most commands need none

    for key in tables:
        if key in SCENE_KEYS and key not in LIGHTS:
            remedy = "give [overrides], [[light]] and [[sun]] only, or a scene without base"
            raise BokehguideError(f"{path}: {key}: has no place beside base; {remedy}")
    root = Table(tables, str(path), "", ("base", "overrides", *LIGHTS))
    base = _base(root, files)
    table = Table(root.values.get("overrides", {}), str(path), "overrides", (*KEYS, "exposure"))
    values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in table.values.items()}
    film = {"exposure": read_exposure(table)} if "exposure" in table else {}
    values.pop("exposure", None)
    maps = ["environment"] if table.text("environment").endswith((".hdr", ".exr")) else []
    for key in ("aperture_image", *maps):
        if key in table:
            values[key] = str(files.named(table, key))
    try:
        return DerivedScene(base, Overrides(**values), film, root)
    except BokehguideError as error:
        raise BokehguideError(f"{path}: overrides: {error}") from None


def _base(root: Table, files: SceneFiles) -> str:
    """The base: a built-in name, or the path of a file."""
    base = root.text("base")
    if not base:
        root.fail("base", "names no scene; give a built-in scene, a scene file or a model")
    if base in BUILTIN:
        return base
    near = [] if Path(base).suffix else get_close_matches(base, BUILTIN, n=1)
    if near and not files.find(Path(root.file).parent, base, root.place("base")).exists():
        root.fail("base", f"is no built-in scene and no file; did you mean {near[0]!r}?")
    return str(files.named(root, "base"))


def derived_text(base: str, overrides: Overrides, exposure: float | str | None, comment: str) -> str:
    """The text of a `.toml` file with this derived scene.

    exposure: in EV or "auto", None for that of the base. comment: the first lines of the text, without `#`.
    """
    values = overrides.given | ({} if exposure is None else {"exposure": exposure})
    lines = [*(f"# {line}" for line in comment.splitlines()), f"base = {_toml(base)}", "", "[overrides]"]
    return "\n".join([*lines, *(f"{key} = {_toml(value)}" for key, value in values.items())]) + "\n"


def _toml(value: Any) -> str:
    """A number, a text, true or a tuple of numbers in TOML."""
    if value is True:
        return "true"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(f"\\u{ord(mark):04x}" if ord(mark) < 32 or ord(mark) == 127 else mark for mark in escaped) + '"'
    return repr(value)
