"""PLY files with normals, texture coordinates and polygons of any number of corners; also compressed as `.ply.gz`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.limits import LARGEST
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.pbrt.tokens import read_bytes

TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
TYPES |= {
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
"""Types of numbers by their names in a header."""
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
UV_NAMES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
"""Names of the properties that hold texture coordinates."""
INDEX_NAMES = ("vertex_indices", "vertex_index")
MAX_HEADER = 2**16
"""Bytes of a header."""
MAX_CORNERS = 1000
"""Corners of a polygon."""
Ply = tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]


class _Damaged(Exception):
    """What is wrong with a file."""


@dataclass
class _Element:
    """An element of a header. scalars: types by name. lists: types of the length and of the values by name."""

    name: str
    count: int
    properties: dict[str, tuple[str, ...]] = field(default_factory=dict)


def read_ply(path: Path, files: SceneFiles, place: str) -> Ply:
    """Points `[V, 3]`, triangles `[T, 3]`, normals `[V, 3]` or None, and uvs `[V, 2]` or None; v points upwards.

    place: where the file is named. Raises BokehguideError for a missing, damaged or empty file.
    """
    require_file(path, "model", place)
    data = read_bytes(path, files)
    try:
        order, elements, start = _header(data)
        reader = _Ascii(data[start:]) if order == "" else _Binary(data, start, order)
        columns: dict[str, np.ndarray] = {}
        triangles = np.zeros((0, 3), np.int64)
        for element in elements:
            if element.name == "vertex":
                columns = reader.scalars(element)
            elif element.name == "face":
                triangles = _fans(*reader.lists(element))
            else:
                reader.lists(element)
    except _Damaged as error:
        raise BokehguideError(f"{path}: not a readable .ply model ({error})") from None
    points = _side_by_side(columns, ("x", "y", "z"))
    if points is None or len(triangles) == 0:
        raise BokehguideError(f"{path}: holds no triangles of finite vertices; give a model with a surface")
    uvs = next((found for names in UV_NAMES if (found := _side_by_side(columns, names)) is not None), None)
    return points, triangles, _side_by_side(columns, ("nx", "ny", "nz")), uvs


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Order of the bytes, elements, and the offset of the values."""
    end = data.find(b"end_header", 0, MAX_HEADER)
    line_end = data.find(b"\n", end, MAX_HEADER)
    if not data.startswith(b"ply") or end < 0 or line_end < 0:
        raise _Damaged("no header of a PLY file")
    order, elements = None, list[_Element]()
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = ORDERS.get(words[1])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 12:
            elements.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements and len(words) >= 3:
            kinds = words[2:4] if words[1] == "list" else words[1:2]
            if not all(kind in TYPES for kind in kinds):
                raise _Damaged(f"a property of unknown type: {printable(line)}")
            elements[-1].properties[words[-1]] = tuple(TYPES[kind] for kind in kinds)
        elif words[:1] not in ([], ["comment"], ["obj_info"]):
            raise _Damaged(f"an unknown line: {printable(line)}")
    if order is None:
        raise _Damaged("no known format")
    return order, elements, line_end + 1


class _Binary:
    """Reads elements from bytes in order."""

    def __init__(self, data: bytes, start: int, order: str):
        self._data, self._offset, self._order = data, start, order
        self._endian: Literal["big", "little"] = "big" if order == ">" else "little"

    def scalars(self, element: _Element) -> dict[str, np.ndarray]:
        """The columns `[N]` of an element without lists."""
        if any(len(kinds) > 1 for kinds in element.properties.values()):
            raise _Damaged("vertices with lists")
        row = np.dtype([(name, self._order + kinds[0]) for name, kinds in element.properties.items()])
        if row.itemsize * element.count > len(self._data) - self._offset:
            raise _Damaged("fewer values than its header names")
        if row.itemsize == 0:
            return {}
        values = np.frombuffer(self._data, row, element.count, self._offset)
        self._offset += row.itemsize * element.count
        return {name: values[name] for name in element.properties}

    def lists(self, element: _Element) -> tuple[np.ndarray, np.ndarray]:
        """Lengths `[N]` of the lists of indices of an element, and their values one after the other."""
        if element.count > len(self._data) - self._offset:
            raise _Damaged("fewer values than its header names")
        lengths, starts = np.zeros(element.count, np.int64), np.zeros(element.count, np.int64)
        kind = "i4"
        steps = []
        for name, kinds in element.properties.items():
            steps.append(
                (name in INDEX_NAMES, np.dtype(kinds[0]).itemsize, np.dtype(kinds[-1]).itemsize if len(kinds) > 1 else 0)
            )
            kind = kinds[-1] if name in INDEX_NAMES and len(kinds) > 1 else kind
        offset, data, size = self._offset, self._data, len(self._data)
        for row in range(element.count):
            for indices, length, width in steps:
                after = offset + length
                count = int.from_bytes(data[offset:after], self._endian) if width else 0
                if after + count * width > size or (indices and count > MAX_CORNERS):
                    raise _Damaged("fewer values than its header names")
                if indices:
                    lengths[row], starts[row] = count, after
                offset = after + count * width
        self._offset = offset
        return lengths, self._gathered(lengths, starts, np.dtype(self._order + kind))

    def _gathered(self, lengths: np.ndarray, starts: np.ndarray, kind: np.dtype) -> np.ndarray:
        """The values of lists, each from its start."""
        total = int(lengths.sum())
        within = np.arange(total) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        at = np.repeat(starts, lengths) + within * kind.itemsize
        raw = np.frombuffer(self._data, np.uint8)[at[:, None] + np.arange(kind.itemsize)]
        values = np.ascontiguousarray(raw).view(kind).reshape(-1)
        return np.nan_to_num(values.astype(np.float64), nan=-1.0).clip(-1.0, 2.0**31).astype(np.int64)


class _Ascii:
    """Reads elements from a text in order."""

    def __init__(self, data: bytes):
        try:
            self._values = np.array(data.split(), np.float64)
        except ValueError:
            raise _Damaged("a word among the numbers") from None
        self._offset = 0

    def scalars(self, element: _Element) -> dict[str, np.ndarray]:
        """The columns `[N]` of an element without lists."""
        width = len(element.properties)
        rows = self._values[self._offset : self._offset + element.count * width]
        if len(rows) < element.count * width or any(len(kinds) > 1 for kinds in element.properties.values()):
            raise _Damaged("fewer values than its header names")
        self._offset += element.count * width
        return dict(zip(element.properties, rows.reshape(element.count, width).T))

    def lists(self, element: _Element) -> tuple[np.ndarray, np.ndarray]:
        """Lengths `[N]` of the lists of indices of an element, and their values one after the other."""
        values, offset, size = self._values, self._offset, len(self._values)
        if element.count > size - offset:
            raise _Damaged("fewer values than its header names")
        lengths, parts = np.zeros(element.count, np.int64), []
        for row in range(element.count):
            for name, kinds in element.properties.items():
                if offset >= size or not 0 <= (count := values[offset] if len(kinds) > 1 else 0) <= MAX_CORNERS:
                    raise _Damaged("fewer values than its header names")
                end = offset + 1 + int(count)
                if name in INDEX_NAMES and len(kinds) > 1:
                    lengths[row] = int(count)
                    parts.append(values[offset + 1 : end])
                offset = end
        self._offset = offset
        indices = np.concatenate(parts) if parts else np.zeros(0)
        if offset > size:
            raise _Damaged("fewer values than its header names")
        return lengths, np.nan_to_num(indices, nan=-1.0).clip(-1.0, 2.0**31).astype(np.int64)


def _fans(lengths: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Polygons as fans of triangles `[T, 3]`. lengths: `[N]` corners of each; indices: of all corners."""
    starts = np.cumsum(lengths) - lengths
    fans = [np.zeros((0, 3), np.int64)]
    for corners in np.unique(lengths[lengths >= 3]):
        first = starts[lengths == corners]
        fan = np.stack([np.zeros(corners - 2, np.int64), np.arange(1, corners - 1), np.arange(2, corners)], axis=1)
        fans.append(indices[first[:, None, None] + fan].reshape(-1, 3))
    return np.concatenate(fans)


def _side_by_side(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    """Properties of the vertices, float64 `[V, C]`; None if one is missing or out of range."""
    if not all(name in columns for name in names):
        return None
    values = np.stack([columns[name].astype(np.float64) for name in names], axis=1)
    return values if (np.abs(values) <= LARGEST).all() else None
