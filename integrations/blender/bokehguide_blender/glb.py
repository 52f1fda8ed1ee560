"""Binary glTF files. Needs no Blender."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

HEADER = struct.Struct("<4sII")
"""Magic, version and length of a file."""
CHUNK = struct.Struct("<I4s")
"""Length and type of a chunk."""
TRANSMISSION, VOLUME = "KHR_materials_transmission", "KHR_materials_volume"


def complete_glb(path: Path) -> bool:
    """Make the transmissive materials of a file solid; returns whether the file has meshes.

    Cycles refracts at every transmissive surface. In glTF, a transmissive surface is a thin sheet without a thickness.
    """
    data = path.read_bytes()
    start = HEADER.size + CHUNK.size
    (length, _) = CHUNK.unpack_from(data, HEADER.size)
    document: dict[str, Any] = json.loads(data[start : start + length])
    if _make_solid(document):
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        rest = data[start + length :]
        header = HEADER.pack(b"glTF", 2, start + len(text) + len(rest))
        path.write_bytes(header + CHUNK.pack(len(text), b"JSON") + text + rest)
    return bool(document.get("meshes"))


def _make_solid(document: dict[str, Any]) -> bool:
    """Add a thickness to transmissive materials without one; returns whether there are any."""
    found = False
    for material in document.get("materials", ()):
        extensions = material.get("extensions", {})
        if TRANSMISSION in extensions and "thicknessFactor" not in extensions.get(VOLUME, {}):
            extensions[VOLUME] = {"thicknessFactor": 1.0} | extensions.get(VOLUME, {})
            found = True
    if found:
        document["extensionsUsed"] = sorted({VOLUME, *document.get("extensionsUsed", ())})
    return found
