"""A glTF file: its JSON and its buffers.

pygltflib is not used: it needs a minute for a file of 20,000 nodes, and checks neither
types nor the bounds of a GLB's chunks.
"""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.gltf.meshopt_views import compression, decode_view
from bokehguide.scene.gltf.parts import Part
from bokehguide.scene.losses import Losses
from bokehguide.stopping import default_signals

JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


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
    notes: Losses = field(default_factory=Losses)
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
        self.notes.add(what, name)

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
            self._decoded[index] = decode_view(self.files, view, packed, self._stored(packed))
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
        problem = f"damaged JSON: {reason(error)}" if text.lstrip()[:1] == b"{" else "neither a GLB nor JSON" if text else "empty"
        raise BokehguideError(f"{path}: not a readable {path.suffix} model ({problem}); export it or fetch it again") from None
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
