"""Small files, all under 1 MB, that would take minutes or gigabytes without bounds."""

from __future__ import annotations

import base64
import io
import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR

from tests.support.scene_text import CAMERA

UNSTORED = 2**20
"""Elements of an accessor without a buffer view."""


def gltf(**sections: object) -> dict:
    """A document with the triangle `(0, 0, 0), (1, 0, 0), (0, 1, 0)`: accessor 0 its positions, accessor 1 unstored zeros."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes() + np.arange(3, dtype=np.uint8).tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(corners).decode()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "buffers": [{"uri": uri, "byteLength": len(corners)}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 3}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"componentType": 5126, "count": UNSTORED, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": 3, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
    }
    document |= sections
    document.setdefault("scenes", [{"nodes": list(range(len(document["nodes"])))}])
    return document


def instances() -> dict:
    """19 nodes with a million instances each."""
    node = {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 1}}}}
    return gltf(nodes=[node] * 19)


def one_accessor() -> dict:
    """3,000 primitives with three of a million positions each, some of which are sparse."""
    document = gltf()
    sparse = {"count": 3, "indices": {"bufferView": 1, "componentType": 5121}, "values": {"bufferView": 0}}
    document["accessors"][1]["sparse"] = sparse
    document["meshes"] = [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 2}] * 3000}]
    return document


def skins() -> dict:
    """8,000 skins, each of one node."""
    count = 8000
    return gltf(
        nodes=[{"mesh": 0, "skin": number} for number in range(count)],
        skins=[{"joints": [number]} for number in range(count)],
    )


def joints() -> dict:
    """4,000 nodes with one skin of 20,000 joints."""
    return gltf(nodes=[{"mesh": 0, "skin": 0}] * 4000 + [{}] * 20000, skins=[{"joints": list(range(4000, 24000))}])


def chain() -> dict:
    """50,000 nodes, each the child of the one before."""
    nodes = [{"children": [number + 1]} for number in range(35000)] + [{"mesh": 0}]
    return gltf(nodes=nodes, scenes=[{"nodes": [0]}])


def lights(kind: str = "point", count: int = 15000) -> dict:
    """Lights of one kind."""
    node = {"extensions": {"KHR_lights_punctual": {"light": 0}}}
    found = {"KHR_lights_punctual": {"lights": [{"type": kind, "range": 1}]}}
    return gltf(nodes=[{"mesh": 0}] + [node] * count, extensions=found)


def meshes() -> dict:
    """2,000 nodes with a mesh of 2,000 primitives."""
    return gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}}] * 2000}], nodes=[{"mesh": 0}] * 2000)


def png(width: int, height: int) -> bytes:
    """A black RGB image."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + 3 * width)) for _ in range(height)) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        chunk(kind, data)
        for kind, data in (
            (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
            (b"IDAT", rows),
            (b"IEND", b""),
        )
    )


def textures(folder: Path) -> dict:
    """100 images that are one file of 32 million pixels."""
    (folder / "black.png").write_bytes(png(8192, 4096))
    count = 100
    texture = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": number}}} for number in range(count)]
    document = gltf(images=[{"uri": "black.png"}] * count, textures=[{"source": n} for n in range(count)], materials=texture)
    document["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}, "material": n} for n in range(count)]}]
    return document


def write_map(path: Path, width: int, height: int) -> None:
    """An EXR of one colour."""
    rows = np.zeros((height, width), np.float16)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict.fromkeys("RGB", rows)).write(str(path))


def scene(text: str) -> str:
    return CAMERA + "[materials.a]\n" + text


BALL = '[[object]]\nshape="sphere"\nmaterial="a"\n'
GLTF: dict[str, Callable[[], dict]] = {
    "instances": instances,
    "one accessor": one_accessor,
    "skins": skins,
    "joints": joints,
    "chain": chain,
    "lights": lights,
    "suns": lambda: lights("directional", 12000),
    "meshes": meshes,
}
TOML = {
    "dotted keys": "a" + ".a" * 30000 + " = 1\n",
    "dotted table": "[a" + " . 'a'" * 30000 + "]\n",
    "spheres": scene(BALL * 15000),
    "boxes": scene(BALL.replace("sphere", "box") * 18000),
}


def scenes(folder: Path) -> dict[str, Path]:
    """Scene files by what they have much of."""
    paths = {}
    for name, make in GLTF.items():
        paths[name] = folder / f"{name}.gltf"
        paths[name].write_text(json.dumps(make(), separators=(",", ":")))
    for name, text in TOML.items():
        paths[name] = folder / f"{name}.toml"
        paths[name].write_text(text)
    paths["textures"] = folder / "textures.gltf"
    paths["textures"].write_text(json.dumps(textures(folder)))
    for width, height in ((4096, 2048), (16384, 8192)):
        write_map(folder / f"{width}.exr", width, height)
        paths[f"map {width}"] = folder / f"map {width}.toml"
        paths[f"map {width}"].write_text(CAMERA + f'[environment]\nmap="{width}.exr"\n[materials.a]\n' + BALL)
    return paths


def checkpoint(pickled: bytes) -> bytes:
    """A file as torch writes it, around a pickle."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in (("data.pkl", pickled), ("byteorder", b"little"), ("version", b"3\n")):
            archive.writestr(f"archive/{name}", data)
    return file.getvalue()


def nested(fingerprint: dict[str, str]) -> bytes:
    """A checkpoint of a render whose parts refer to one another, two to each level, 60 levels deep."""
    part: object = []
    for _ in range(60):
        part = [part, part]
    return checkpoint(pickle.dumps({"fingerprint": fingerprint, "seconds": 1.0, "loop": part}, protocol=2))


def byte_array(size: int = 6_000_000_000) -> bytes:
    """A checkpoint that builds an array of `size` bytes."""
    number = size.to_bytes(8, "little")
    return checkpoint(b"\x80\x02}X\x0b\x00\x00\x00fingerprintc__builtin__\nbytearray\n\x8a\x08" + number + b"\x85Rs.")
