"""EXT_meshopt_compression and KHR_meshopt_compression: buffer views, decoded by meshoptimizer."""

from __future__ import annotations

from collections.abc import Container

import meshopt

from bokehguide.errors import BokehguideError, reason
from bokehguide.limits import MAX_INT
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.gltf.parts import Part
from bokehguide.stopping import default_signals

EXTENSIONS = ("KHR_meshopt_compression", "EXT_meshopt_compression")
"""The second is the older one: its bitstream is a subset, and it has no filter COLOR."""
MODES: tuple[meshopt.Mode, ...] = ("ATTRIBUTES", "TRIANGLES", "INDICES")
STRIDES: dict[meshopt.Filter, Container[int]] = {
    "NONE": range(4, 257, 4),
    "OCTAHEDRAL": (4, 8),
    "QUATERNION": (8,),
    "EXPONENTIAL": range(4, 257, 4),
    "COLOR": (4, 8),
}
"""Permitted strides of the mode ATTRIBUTES by filter, in bytes."""
INDEX_STRIDES = (2, 4)
MAX_RATIO = {"ATTRIBUTES": 1024, "TRIANGLES": 12, "INDICES": 4}
"""Bytes that one stored byte can decode to. A stored byte holds the headers of four blocks of 256 bytes that are all 0, one
triangle, or one index."""


def compression(view: Part) -> Part | None:
    """The extension of a buffer view that compresses it, None for plain data."""
    name = next((name for name in EXTENSIONS if name in view.extensions), None)
    return None if name is None else view.extension(name)


def decode_view(files: SceneFiles, view: Part, packed: Part, data: memoryview) -> bytes:
    """The plain bytes of a buffer view. files: of the scene. packed: the extension of the view; data: the compressed bytes.

    Raises BokehguideError for values that the extension does not permit, for damaged data, and for more decoded bytes than
    the scene may have.
    """
    count, stride = packed.whole("count", None), packed.whole("byteStride", None)
    mode = _mode(packed)
    compressor = _filter(packed, mode)
    if count is None or stride is None:
        packed.missing("count" if count is None else "byteStride", "repair the file")
    strides = STRIDES[compressor] if mode == "ATTRIBUTES" else INDEX_STRIDES
    if stride not in strides or view.whole("byteStride", stride) != stride:
        packed.fail("byteStride", f"does not suit the mode {mode} with the filter {compressor}, or the view; repair the file")
    if mode == "TRIANGLES" and count % 3:
        packed.fail("count", "is no multiple of 3, as the mode TRIANGLES requires; repair the file")
    if view.whole("byteLength", 0) != count * stride or count * stride > MAX_INT:
        view.fail("byteLength", f"is not {count} elements of {stride} bytes; repair the file")
    if count * stride > MAX_RATIO[mode] * len(data):
        packed.fail("count", f"needs more than the {len(data)} bytes of compressed data; fetch the file again")
    place = f"{view.file}: {packed.path}"
    files.reserve_decoded(count * stride, len(data), place)
    if not count:
        return b""
    try:
        with default_signals():
            return meshopt.decode_gltf_buffer(bytes(data), count, stride, mode, compressor).tobytes()
    except (ValueError, RuntimeError) as error:
        raise BokehguideError(f"{place}: damaged data ({reason(error)}); fetch the file again") from None


def _mode(packed: Part) -> meshopt.Mode:
    """The compression mode."""
    for mode in MODES:
        if mode == packed.text("mode"):
            return mode
    return packed.fail("mode", f"is none of {', '.join(MODES)}; repair the file")


def _filter(packed: Part, mode: meshopt.Mode) -> meshopt.Filter:
    """The filter after the decompression, "NONE" by default."""
    older = not packed.path.endswith(EXTENSIONS[0])
    known: list[meshopt.Filter] = [name for name in STRIDES if not (older and name == "COLOR")]
    for name in known:
        if name == (packed.text("filter") or "NONE"):
            if name != "NONE" and mode != "ATTRIBUTES":
                packed.fail("filter", "needs the mode ATTRIBUTES; repair the file")
            return name
    return packed.fail("filter", f"is none of {', '.join(known)}; repair the file")
