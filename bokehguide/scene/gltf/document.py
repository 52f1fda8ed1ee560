"""A glTF file: checked reading of its JSON, and its buffers.

pygltflib is not used: it needs a minute for a file of 20,000 nodes, and checks neither
types nor the bounds of a GLB's chunks.
"""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn, TypeVar
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.limits import MAX_INT
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.gltf.meshopt_views import compression, decode_view
from bokehguide.scene.tables import ANY, Limits, Table, is_number, shown
from bokehguide.scene.vectors import Vector, as_vector
from bokehguide.stopping import default_signals

JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
ROUNDING = 1e-6
"""Relative error of numbers in files: a white of 1.00000012 is 1 plus one digit of single precision."""
Default = TypeVar("Default", int, None)


class Part(Table):
    """One JSON object of a glTF file, such as a node. A null value counts as absent.

    Its readers raise BokehguideError naming file, object, key and value. They ignore unknown keys,
    as the format is extensible.
    """

    def __init__(self, values: Any, file: str, path: str):
        if not isinstance(values, dict):
            place = f"{file}: {path}" if path else file
            raise BokehguideError(f"{place}: {shown(values)} is not a JSON object; repair the file")
        present = {key: value for key, value in values.items() if value is not None}
        super().__init__(present, file, path, present)

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise the error that the value of `key` has `problem`, or that `key` is absent."""
        if key not in self:
            self.missing(key, "repair the file")
        super().fail(key, problem)

    def missing(self, key: str, remedy: str) -> NoReturn:
        """Raise the error that `key` is absent."""
        super().missing(key, "repair the file")

    def whole(self, key: str, default: Default, most: int = MAX_INT) -> int | Default:
        """A whole number from 0 to `most`."""
        if key not in self:
            return default
        value = self.values[key]
        if not is_number(value) or not 0 <= value <= most or value != int(value):
            self.fail(key, f"is not a whole number from 0 to {most}; repair the file")
        return int(value)

    def number(self, key: str, default: float | None, limits: Limits = ANY) -> float:
        """A number within `limits`, as exporters round it."""
        return _rounded(super().number(key, default, _tolerant(limits)), limits)

    def vector(self, key: str, default: Vector | None, limits: Limits = ANY) -> Vector:
        """Three numbers, each within `limits`, as exporters round them."""
        return as_vector(_rounded(value, limits) for value in super().vector(key, default, _tolerant(limits)))

    def numbers(self, key: str, count: int, default: tuple[float, ...], limits: Limits = ANY) -> tuple[float, ...]:
        """`count` numbers, each within `limits`, as exporters round them."""
        if key not in self:
            return default
        values = self.values[key]
        if not (isinstance(values, list) and len(values) == count and all(map(is_number, values))):
            self.fail(key, f"is not a list of {count} numbers; repair the file")
        if not all(map(_tolerant(limits).contains, values)):
            self.fail(key, f"is out of range; give {count} values, each {limits.remedy}")
        return tuple(_rounded(float(value), limits) for value in values)

    def part(self, key: str) -> Part:
        """The object `key`, empty if absent."""
        return Part(self.values.get(key, {}), self.file, f"{self.path}.{key}" if self.path else key)

    def parts(self, key: str) -> list[Part]:
        """The objects of the list `key`, empty if absent. Their paths contain index and name."""
        values = self.values.get(key, [])
        if not isinstance(values, list):
            self.fail(key, "is not a list; repair the file")
        path = f"{self.path}.{key}" if self.path else key
        return [Part(value, self.file, f"{path}[{index}]{_named(value)}") for index, value in enumerate(values)]

    @cached_property
    def extensions(self) -> dict[str, Any]:
        """The values of the extensions by name."""
        return self.part("extensions").values

    def extension(self, name: str) -> Part:
        """The extension `name`, empty if absent."""
        return Part(self.extensions.get(name, {}), self.file, f"{self.path}.{name}" if self.path else name)

    @property
    def label(self) -> str:
        """The object's name, or its path in the file if it has none."""
        name = self.values.get("name")
        return printable(name) if isinstance(name, str) and name.strip() else self.path


def _tolerant(limits: Limits) -> Limits:
    """`limits` that also contain a value above the largest by an error of rounding."""
    return replace(limits, high=limits.high * (1.0 + ROUNDING))


def _rounded(value: float, limits: Limits) -> float:
    """`value`, or the largest value of `limits` if it is just above."""
    return limits.high if limits.high < value <= _tolerant(limits).high else value


def _named(value: Any) -> str:
    """The suffix of an object's path: its name in parentheses, or nothing."""
    name = value.get("name") if isinstance(value, dict) else None
    return f" ({printable(name)})" if isinstance(name, str) and name.strip() else ""


@dataclass
class Document:
    """A glTF file: its JSON, the binary chunk of a `.glb`, the files that it may name, and notes.

    notes: unsupported features, each with the names of its objects, in order. sparse: the last accessors with sparse values, by
    index. unstored: elements of accessors without a buffer view, by index.
    """

    path: Path
    root: Part
    chunk: bytes | None
    files: SceneFiles
    notes: dict[str, dict[str, None]] = field(default_factory=dict)
    sparse: dict[int, np.ndarray] = field(default_factory=dict)
    unstored: dict[int, int] = field(default_factory=dict)
    _items: dict[str, list[Part]] = field(default_factory=dict)
    _buffers: dict[int, bytes] = field(default_factory=dict)
    _decoded: dict[int, bytes] = field(default_factory=dict)
    _read: dict[Path, bytes] = field(default_factory=dict)

    @property
    def file(self) -> str:
        """The path as text."""
        return str(self.path)

    def note(self, what: str, name: str = "") -> None:
        """Add the unsupported feature `what`, and the name of an object that uses it."""
        names = self.notes.setdefault(what, {})
        if name:
            names[name] = None

    def items(self, section: str) -> list[Part]:
        """All objects of a top-level list, such as "nodes"."""
        if section not in self._items:
            self._items[section] = self.root.parts(section)
        return self._items[section]

    def link(self, part: Part, key: str, section: str) -> int | None:
        """The index `key` into `section`, None if absent."""
        index = part.whole(key, None)
        if index is not None and index >= len(self.items(section)):
            part.fail(key, f"is no index into {section}, which has {len(self.items(section))}; repair the file")
        return index

    def required(self, part: Part, key: str, section: str) -> int:
        """The index `key` into `section`. Raises BokehguideError if it is absent."""
        index = self.link(part, key, section)
        return part.missing(key, "repair the file") if index is None else index

    def links(self, part: Part, key: str, section: str) -> list[int]:
        """The list of indices `key` into `section`."""
        values = part.values.get(key, [])
        if not isinstance(values, list) or None in values:
            part.fail(key, "is not a list of indices; repair the file")
        path = part.place(key).removeprefix(f"{part.file}: ")
        entries = Part({str(number): value for number, value in enumerate(values)}, part.file, path)
        return [self.required(entries, key, section) for key in entries.values]

    def names(self, key: str) -> list[str]:
        """A top-level list of strings, such as "extensionsRequired"."""
        values = self.root.values.get(key, [])
        if not (isinstance(values, list) and all(isinstance(value, str) for value in values)):
            self.root.fail(key, "is not a list of strings; repair the file")
        return values

    def view(self, index: int) -> memoryview:
        """The bytes of a buffer view, decoded if it is compressed."""
        view = self.items("bufferViews")[index]
        packed = compression(view)
        if packed is None:
            return self._stored(view)
        if index not in self._decoded:
            self._decoded[index] = decode_view(self, view, packed, self._stored(packed))
        return memoryview(self._decoded[index])

    def _stored(self, part: Part) -> memoryview:
        """The bytes in a buffer that `part` refers to, a buffer view or an extension of one."""
        data = self._buffer(self.required(part, "buffer", "buffers"), part)
        start, length = part.whole("byteOffset", 0), part.whole("byteLength", 0)
        if start + length > len(data):
            part.fail("byteLength", f"from byte {start} on is beyond its buffer's {len(data)} bytes; repair the file")
        return memoryview(data)[start : start + length]

    def _buffer(self, index: int, view: Part) -> bytes:
        """The bytes of a buffer. view: one of its views, for errors."""
        if index not in self._buffers:
            buffer = self.items("buffers")[index]
            if "uri" in buffer:
                self._buffers[index] = self.resource(buffer)
            elif index == 0 and self.chunk is not None:
                self._buffers[index] = self.chunk
            else:
                packed = f", and {printable(', '.join(view.extensions))} is not read" if view.extensions else ""
                raise BokehguideError(f"{self.file}: {buffer.path}: has no data{packed}; save the file uncompressed")
            length = len(self._buffers[index])
            if buffer.whole("byteLength", 0) > length:
                buffer.fail("byteLength", f"is more than the {length} bytes there are; fetch the file again")
        return self._buffers[index]

    def resource(self, part: Part) -> bytes:
        """The bytes behind the `uri` of a buffer or an image: a data URI, or a file relative to the model."""
        uri = part.text("uri")
        try:
            if uri.startswith("data:"):
                head, _, body = uri.partition(",")
                if head.endswith(";base64"):
                    return base64.b64decode(unquote(body), validate=True)
                return unquote_to_bytes(body)
            path = self.files.find(self.path.parent, unquote(uri), part.place("uri"))
            if not path.is_file():
                part.fail("uri", "is no file beside the model; put it there")
            if path not in self._read:
                self._read[path] = self.files.read(path)
            return self._read[path]
        except (OSError, ValueError) as error:
            part.fail("uri", f"cannot be read ({error}); repair the file")


def read_document(path: Path, files: SceneFiles) -> Document:
    """The document of a `.gltf` or `.glb`. Raises BokehguideError for an unreadable file or another version."""
    data = files.read(path)
    text, chunk = _chunks(data, path) if data[:4] == b"glTF" else (data, None)
    try:
        with default_signals():  # the parser holds the interpreter's lock
            values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BokehguideError(f"{path}: not a readable {path.suffix} model ({reason(error)})") from None
    document = Document(path, Part(values, str(path), ""), chunk, files)
    asset = document.root.part("asset")
    if not str(asset.values.get("version", "2.0")).startswith("2."):
        asset.fail("version", "is not glTF 2; convert the file")
    return document


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """The JSON chunk and the binary chunk of a GLB, None if absent."""
    chunks: dict[int, bytes] = {}
    if len(data) < 12 or struct.unpack_from("<I", data, 4)[0] != 2:
        raise BokehguideError(f"{path}: not a readable {path.suffix} model (no GLB of version 2); convert it")
    end, position = struct.unpack_from("<I", data, 8)[0], 12
    while position + 8 <= min(end, len(data)):
        length, kind = struct.unpack_from("<II", data, position)
        position += 8
        if position + length > len(data):
            raise BokehguideError(f"{path}: not a readable {path.suffix} model (cut short); fetch it again")
        chunks.setdefault(kind, data[position : position + length])
        position += length
    if JSON_CHUNK not in chunks:
        raise BokehguideError(f"{path}: not a readable {path.suffix} model (no JSON chunk); fetch it again")
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK)
