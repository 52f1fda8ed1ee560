"""Binary glTF files. Needs no Blender."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

HEADER = struct.Struct("<4sII")
"""Magic, version and length of a file."""
CHUNK = struct.Struct("<I4s")
"""Length and type of a chunk."""
TRANSMISSION, VOLUME = "KHR_materials_transmission", "KHR_materials_volume"
Document = dict[str, Any]


def read_glb(path: Path) -> tuple[Document, bytes]:
    """The JSON document of a file, and the chunks after it."""
    data = path.read_bytes()
    start = HEADER.size + CHUNK.size
    (length, _) = CHUNK.unpack_from(data, HEADER.size)
    return json.loads(data[start : start + length]), data[start + length :]


def write_glb(path: Path, document: Document, rest: bytes) -> None:
    """Write a file of a document and the chunks after it."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    start = HEADER.size + CHUNK.size
    header = HEADER.pack(b"glTF", 2, start + len(text) + len(rest))
    path.write_bytes(header + CHUNK.pack(len(text), b"JSON") + text + rest)


def complete_glb(path: Path, materials: Mapping[str, Document], textures: Mapping[str, Mapping[str, bytes]]) -> bool:
    """Replace the materials of a file by name, and make transmissive ones solid; returns whether the file has meshes.

    textures: PNG files by material and texture, for `replace_textures`.

    Cycles refracts at every transmissive surface. In glTF, a transmissive surface is a thin sheet without a thickness.
    """
    document, rest = read_glb(path)
    rest, changed = replace_textures(document, rest, textures)
    if _replace(document, materials) | _make_solid(document) | changed:
        write_glb(path, document, rest)
    return bool(document.get("meshes"))


def split_glb(path: Path, groups: Mapping[str, str]) -> dict[str, Path]:
    """Move the emissive nodes of light groups into files beside `path`; returns the files by group, the others under "".

    groups: the light group of nodes by name. Files without a mesh are left out. A file is complete, with the nodes of `path`.
    """
    document, rest = read_glb(path)
    emissive = _emissive_meshes(document)
    placed = [
        groups.get(node.get("name", ""), "") if node.get("mesh") in emissive else "" if "mesh" in node else None
        for node in document.get("nodes", ())
    ]
    files = {}
    for group in dict.fromkeys(each for each in placed if each is not None):
        files[group] = path.with_stem(f"{path.stem}-{group}") if group else path
        nodes = [
            {key: value for key, value in node.items() if key != "mesh" or of == group}
            for node, of in zip(document["nodes"], placed)
        ]
        if any(placed):
            write_glb(files[group], document | {"nodes": nodes}, rest)
    return files


def _emissive_meshes(document: Document) -> set[int]:
    """The indices of the meshes with an emissive material."""
    materials = [max(each.get("emissiveFactor", (0.0,))) > 0.0 for each in document.get("materials", ())]
    return {
        number
        for number, mesh in enumerate(document.get("meshes", ()))
        if any("material" in part and materials[part["material"]] for part in mesh["primitives"])
    }


def replace_textures(document: Document, rest: bytes, textures: Mapping[str, Mapping[str, bytes]]) -> tuple[bytes, bool]:
    """Replace images of materials in a document; returns the chunks after it, and whether there are any.

    textures: PNG files by material and by `baseColorTexture` or `emissiveTexture`.
    """
    data = bytearray(rest[CHUNK.size :])
    changed = False
    for material in document.get("materials", ()):
        for slot, content in textures.get(material.get("name"), {}).items():
            owner = material.get("pbrMetallicRoughness", {}) if slot == "baseColorTexture" else material
            if slot in owner:
                number = len(document["textures"])
                document["textures"].append(document["textures"][owner[slot]["index"]] | {"source": len(document["images"])})
                document["images"].append({"mimeType": "image/png", "bufferView": len(document["bufferViews"])})
                document["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content)})
                data += content + bytes(-len(content) % 4)
                owner[slot] = owner[slot] | {"index": number}
                changed = True
    if changed:
        document["buffers"][0]["byteLength"] = len(data)
        rest = CHUNK.pack(len(data), b"BIN\0") + bytes(data)
    return rest, changed


def _replace(document: Document, materials: Mapping[str, Document]) -> bool:
    """Replace keys of the named materials; returns whether there are any."""
    named = [each for each in document.get("materials", ()) if each.get("name") in materials]
    for material in named:
        material |= materials[material["name"]]
        document["extensionsUsed"] = sorted({*material.get("extensions", ()), *document.get("extensionsUsed", ())})
    return bool(named)


def _make_solid(document: Document) -> bool:
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
