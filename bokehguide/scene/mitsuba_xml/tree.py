"""A Mitsuba XML file as a tree of plugins with plain properties, read by Mitsuba's own parser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.limits import LARGEST
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.tables import is_number
from bokehguide.stopping import default_signals

VARIANT = "scalar_rgb"
NAMES = re.compile(r"""<(include|path)\b[^>]*?\b(?:filename|value)\s*=\s*["']([^"']*)["']""")
"""Tags that name further files and folders for Mitsuba's parser."""
SPECTRA = ("d65", "srgb", "uniform")
"""Spectra as plugins that Mitsuba's RGB variants have."""
MAX_NODES = 100_000
"""Objects of a file; each takes a few kilobytes."""


@dataclass(frozen=True)
class Plugin:
    """An object of a file. kind: such as "bsdf". values: numbers, texts, flags, colours `(r, g, b)`, matrices `[4, 4]`, and
    other plugins, by name."""

    kind: str
    type: str
    name: str
    place: str
    values: dict[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The name for messages: the type where the object has no name."""
        return self.name or self.type

    def number(self, key: str, default: float) -> float:
        """A number. Raises BokehguideError for another value."""
        value = self.values.get(key, default)
        if not is_number(value) or not abs(value) <= LARGEST:
            self.fail(key, "is not a number in range; give one")
        return float(value)

    def text(self, key: str, default: str = "") -> str:
        """A text. Raises BokehguideError for another value."""
        value = self.values.get(key, default)
        return value if isinstance(value, str) else self.fail(key, "is not a text; give one")

    def flag(self, key: str, default: bool = False) -> bool:
        """A boolean. Raises BokehguideError for another value."""
        value = self.values.get(key, default)
        return value if isinstance(value, bool) else self.fail(key, "is neither true nor false; give one of them")

    def vector(self, key: str, default: ArrayLike) -> np.ndarray:
        """A point or a direction, float64 `[3]`. Raises BokehguideError for another value."""
        value = self.values.get(key, default)
        if np.shape(value) != (3,) or not (np.abs(value) <= LARGEST).all():
            self.fail(key, "is not three numbers in range; give x, y and z")
        return np.array(value, np.float64)

    def matrix(self, key: str = "to_world") -> np.ndarray:
        """A transform, float64 `[4, 4]`; the identity without one."""
        value = self.values.get(key, np.eye(4))
        if not isinstance(value, np.ndarray) or not np.isfinite(value).all():
            self.fail(key, "is no transform of finite numbers; give one")
        return value

    def inner(self, kind: str) -> list[Plugin]:
        """The nested plugins of a kind."""
        return [value for value in self.values.values() if isinstance(value, Plugin) and value.kind == kind]

    def fail(self, key: str, problem: str) -> Any:
        """Raise the error that the value of `key` has `problem`."""
        raise BokehguideError(f"{self.place}.{key}: {printable(str(self.values.get(key)), 80)} {problem}")


def read_tree(path: Path, files: SceneFiles) -> Plugin:
    """The scene of a file with all its includes. Raises BokehguideError for a missing Mitsuba and for an unreadable file."""
    require_file(path, "scene")
    _check_names(path, files, set())
    with mitsuba(str(path)) as mi:
        config = mi.parser.ParserConfig(VARIANT)
        config.merge_meshes = config.merge_equivalent = False
        try:
            with default_signals():
                state = mi.parser.parse_file(config, str(path))
                mi.parser.transform_all(config, state)
        except (RuntimeError, ValueError, TypeError) as error:
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            problem = printable(" ".join(lines).replace(str(path), path.name), 300) or reason(error)
            raise BokehguideError(f"{path}: not a readable Mitsuba scene ({problem}){_remedy(problem)}") from None
        if len(state.nodes) > MAX_NODES:
            raise BokehguideError(f"{path}: has {len(state.nodes)} objects; give at most {MAX_NODES}")
        root = _Tree(mi, state, str(path)).plugin(0)
    if root.kind != "scene":
        raise BokehguideError(f"{path}: holds no scene; give a file that begins with <scene>")
    return root


def _remedy(problem: str) -> str:
    """How to repair a file with this error message of Mitsuba's parser, empty if the message says it."""
    parameter = re.search(r"undefined parameter: \$(\w+)", problem)
    return f'; add <default name="{parameter[1]}" value="…"/> at the beginning of <scene>' if parameter else ""


def _check_names(path: Path, files: SceneFiles, seen: set[Path]) -> None:
    """Raise BokehguideError if a file or its includes name a file or a folder outside the scene's folder.

    Mitsuba looks for files in the folders of the file's `<path>` tags first, from the last tag to the first.
    """
    scene = not seen
    seen.add(path.resolve())
    try:
        text = files.read(path).decode("utf-8")
    except (UnicodeDecodeError, OSError) as error:
        raise BokehguideError(f"{path}: not a readable Mitsuba scene ({reason(error)}); save it as UTF-8") from None
    for tag, name in NAMES.findall(text):
        found = files.find(path.parent, name, f"{path}: <{tag}>")
        if tag == "path" and scene:
            files.search_first(found)
        if tag == "include" and found.is_file() and found.resolve() not in seen:
            _check_names(found, files, seen)


def file_of(plugin: Plugin, scene: Path, files: SceneFiles, what: str) -> Path:
    """The file that a plugin names. scene: the scene's file. what: the kind of the file, for errors.

    Raises BokehguideError for a missing file, and for one outside the scene's folder.
    """
    place = f"{plugin.place}.filename"
    path = files.find(scene.parent, plugin.text("filename"), place)
    require_file(path, what, place)
    return path


def as_dictionary(value: Any) -> Any:
    """A property as Mitsuba's `load_dict` takes it, None for a plugin that is no spectrum of SPECTRA."""
    if isinstance(value, Plugin):
        plain = value.type in SPECTRA and not any(isinstance(each, Plugin) for each in value.values.values())
        return {"type": value.type} | {key: as_dictionary(each) for key, each in value.values.items()} if plain else None
    if isinstance(value, tuple):
        return {"type": "rgb", "value": list(value)}
    if hasattr(value, "wavelengths"):
        samples = value.values[0] if value.is_uniform() else list(zip(value.wavelengths, value.values))
        return {"type": "spectrum", "value": samples}
    return value


@contextmanager
def mitsuba(place: str) -> Iterator[ModuleType]:
    """Mitsuba with the variant VARIANT; the earlier variant returns afterwards. Raises BokehguideError if it is missing."""
    try:
        import mitsuba as mi
    except ImportError:
        raise BokehguideError(
            f"{place}: a Mitsuba scene, and Mitsuba is missing; run pip install 'bokehguide[mitsuba]'"
        ) from None
    before = mi.variant()
    mi.set_variant(VARIANT)
    try:
        yield mi
    finally:
        if before not in (None, VARIANT):
            mi.set_variant(before)


class _Tree:
    """The nodes of a parser as plugins, each read once."""

    def __init__(self, mi: ModuleType, state: Any, file: str):
        self._mi, self._nodes, self._file = mi, state.nodes, file
        self._read: dict[int, Plugin] = {}

    def plugin(self, index: int) -> Plugin:
        """The plugin of one node."""
        if index not in self._read:
            node = self._nodes[index]
            kind, name = str(node.type).rpartition(".")[2].lower(), printable(str(node.props.id()))
            place = f"{self._file}: {node.props.plugin_name()}" + (f" ({name})" if name else f" {index}")
            values = {key: self._value(node.props, key) for key in node.props.keys()}  # noqa: SIM118 - no mapping
            self._read[index] = Plugin(kind, node.props.plugin_name(), name, place, values)
        return self._read[index]

    def _value(self, properties: Any, key: str) -> Any:
        """A property in plain types."""
        kinds, kind, value = self._mi.Properties.Type, properties.type(key), properties[key]
        if kind == kinds.ResolvedReference:
            return self.plugin(value.index())
        if kind == kinds.Transform:
            return np.array(value.matrix, np.float64).reshape(4, 4)
        if kind in (kinds.Color, kinds.Vector):
            return tuple(float(each) for each in value)
        return value
