"""Accessors: typed arrays in a file's buffers, with checked offsets."""

from __future__ import annotations

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.limits import MAX_INT
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.parts import Part

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
MAX_UNSTORED = 2**20
"""Limit on the elements of an accessor without a buffer view, which are zeros and take no space in the file."""
MAX_UNSTORED_IN_ALL = 8 * MAX_UNSTORED
"""The same of all accessors of a file."""
KEPT_SPARSE = 8
"""Number of accessors with sparse values that stay decoded: primitives often share them."""


def read_floats(document: Document, index: int, *kinds: str) -> np.ndarray:
    """Accessor `index` as float32 `[count, width]`. Normalised integers map to [0, 1] or [-1, 1].

    kinds: the permitted types, such as "VEC3". Raises BokehguideError naming the accessor for
    another type and for data outside its buffer.
    """
    accessor = document.items("accessors")[index]
    return as_floats(read_raw(document, index, *kinds), accessor.flag("normalized"))


def as_floats(values: np.ndarray, normalized: bool) -> np.ndarray:
    """Components decoded as in glTF 2.0 section 3.11, float32."""
    if values.dtype.kind == "f" or not normalized:
        with np.errstate(over="ignore"):
            return np.ascontiguousarray(values, dtype=np.float32)
    return np.maximum(values / np.float32(np.iinfo(values.dtype).max), np.float32(-1.0))


def read_indices(document: Document, index: int) -> np.ndarray:
    """Accessor `index` as int64 `[count]`. Raises BokehguideError if its components are not unsigned integers."""
    values = read_raw(document, index, "SCALAR")
    if values.dtype.kind != "u":
        document.items("accessors")[index].fail("componentType", "is not an unsigned integer; repair the file")
    return values[:, 0].astype(np.int64)


def read_raw(document: Document, index: int, *kinds: str) -> np.ndarray:
    """Accessor `index` in its stored type, `[count, width]`, with sparse values. Raises as `read_floats` does."""
    accessor = document.items("accessors")[index]
    if accessor.values.get("type") not in kinds:
        accessor.fail("type", f"is not {' or '.join(kinds)}, as its use requires; repair the file")
    if index in document.sparse:
        return document.sparse[index]
    width = WIDTHS[accessor.values["type"]]
    count = accessor.whole("count", 0, MAX_INT if "bufferView" in accessor else MAX_UNSTORED)
    dtype = _dtype(accessor)
    if "bufferView" in accessor:
        values = _strided(document, accessor, dtype, count, width)
    else:
        values = np.broadcast_to(np.zeros(1, dtype), (count, width))
        _count_unstored(document, accessor, index, count)
    if "sparse" in accessor:
        values = values.copy()
        _put_sparse(document, accessor, values)
        document.sparse[index] = values
        if len(document.sparse) > KEPT_SPARSE:
            del document.sparse[next(iter(document.sparse))]
    return values


def _count_unstored(document: Document, accessor: Part, index: int, count: int) -> None:
    """Add the elements of accessor `index` to the number of elements without stored bytes. Raises BokehguideError for
    too many.
    """
    if index not in document.unstored:
        document.unstored[index] = count
        if sum(document.unstored.values()) > MAX_UNSTORED_IN_ALL:
            accessor.fail("count", f"makes more than {MAX_UNSTORED_IN_ALL} elements that no buffer stores; repair the file")


def _dtype(part: Part) -> np.dtype:
    """The type of an accessor's components."""
    kind = part.whole("componentType", None)
    if kind not in COMPONENTS:
        part.fail("componentType", f"is none of {', '.join(map(str, COMPONENTS))}; repair the file")
    return np.dtype(COMPONENTS[kind])


def _strided(document: Document, part: Part, dtype: np.dtype, count: int, width: int) -> np.ndarray:
    """The elements `[count, width]` at the `bufferView` and `byteOffset` of `part`."""
    index = document.required(part, "bufferView", "bufferViews")
    data, view = document.view(index), document.items("bufferViews")[index]
    offset, size = part.whole("byteOffset", 0), dtype.itemsize * width
    stride = view.whole("byteStride", 0) or size
    if stride < size:
        view.fail("byteStride", f"is less than the {size} bytes of an element of {part.path}; repair the file")
    if count and offset + stride * (count - 1) + size > len(data):
        raise BokehguideError(
            f"{part.file}: {part.path}: {count} elements of {size} bytes, {stride} apart from byte {offset} on, "
            f"reach beyond the {len(data)} bytes of {view.path}; repair the file"
        )
    if not count:
        return np.zeros((0, width), dtype)
    return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))


def _put_sparse(document: Document, accessor: Part, values: np.ndarray) -> None:
    """Write the sparse values of an accessor into `values` `[count, width]`."""
    sparse = accessor.part("sparse")
    count, indices = sparse.whole("count", 0, len(values)), sparse.part("indices")
    where = _strided(document, indices, _dtype(indices), count, 1)[:, 0]
    if where.dtype.kind != "u":
        indices.fail("componentType", "is not an unsigned integer; repair the file")
    if count and where.max() >= len(values):
        raise BokehguideError(
            f"{accessor.file}: {indices.path}: {where.max()} is not below {len(values)}, the number of elements; repair the file"
        )
    values[where] = _strided(document, sparse.part("values"), values.dtype, count, values.shape[1])
