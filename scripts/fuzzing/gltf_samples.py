"""glTF files that have nearly everything, written by hand: their JSON is to be damaged value by value."""

from __future__ import annotations

import json
import struct

import DracoPy
import meshopt
import numpy as np

SQUARE = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def gltf_parts() -> tuple[dict, bytes]:
    """The JSON and the one buffer of a file that has nearly everything."""
    arrays = {
        "POSITION": (SQUARE, 5126, "VEC3"),
        "NORMAL": (np.tile(np.float32([0, 0, 1]), (4, 1)), 5126, "VEC3"),
        "TEXCOORD_0": (SQUARE[:, :2] / 2 + 0.5, 5126, "VEC2"),
        "COLOR_0": (np.full((4, 4), 200, np.uint8), 5121, "VEC4"),
        "TANGENT": (np.tile(np.float32([1, 0, 0, 1]), (4, 1)), 5126, "VEC4"),
        "indices": (np.uint16([0, 1, 2, 0, 2, 3]), 5123, "SCALAR"),
        "TRANSLATION": (np.float32([[0, 0, 0], [0, 0, -2]]), 5126, "VEC3"),
        "sparse": (np.uint16([1, 0]), 5123, "SCALAR"),
        "values": (np.float32([[2, 0, 0]]), 5126, "VEC3"),
    }
    data, views, accessors = bytearray(), [], []
    for number, (array, kind, form) in enumerate(arrays.values()):
        data += b"\0" * (-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        accessors.append({"bufferView": number, "componentType": kind, "count": len(array), "type": form})
        data += array.tobytes()
    accessors[3]["normalized"] = True
    where, what = ({"bufferView": number, "byteOffset": 0} for number in (7, 8))
    accessors[6]["sparse"] = {"count": 1, "indices": {**where, "componentType": 5123}, "values": what}
    return {**gltf_scene(), "bufferViews": views, "accessors": accessors}, bytes(data)


def gltf_scene() -> dict:
    """The JSON without the description of the buffer."""
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2, "COLOR_0": 3, "TANGENT": 4}
    plain = {"attributes": {"POSITION": 0}, "indices": 5, "mode": 4, "material": 1}
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 6}}}
    spot = {
        "type": "spot",
        "intensity": 3.0,
        "color": [1, 1, 1],
        "range": 9,
        "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.5},
    }
    lights = [spot, {"type": "directional", "intensity": 2.0}, {"type": "point"}]
    moved = {"KHR_texture_transform": {"offset": [0.1, 0], "rotation": 0.3, "scale": [2, 2]}}
    pbr = {"baseColorFactor": [1, 1, 1, 0.9], "metallicFactor": 0.5, "roughnessFactor": 0.4}
    wood = {
        "name": "wood",
        "alphaMode": "BLEND",
        "doubleSided": True,
        "normalTexture": {"index": 0, "scale": 0.8},
        "pbrMetallicRoughness": {**pbr, "baseColorTexture": {"index": 0, "texCoord": 0, "extensions": moved}},
    }
    glass = {
        "KHR_materials_transmission": {"transmissionFactor": 1},
        "KHR_materials_ior": {"ior": 1.4},
        "KHR_materials_volume": {"thicknessFactor": 1.0, "attenuationDistance": 0.5, "attenuationColor": [0.9, 1, 1]},
        "KHR_materials_clearcoat": {"clearcoatFactor": 1.0},
        "KHR_materials_specular": {"specularFactor": 0.5},
        "KHR_materials_sheen": {"sheenColorFactor": [1, 0.5, 0.2], "sheenRoughnessFactor": 0.5},
        "KHR_materials_anisotropy": {"anisotropyStrength": 0.5, "anisotropyRotation": 1.0},
        "KHR_materials_iridescence": {"iridescenceFactor": 1, "iridescenceThicknessMaximum": 500},
        "KHR_materials_dispersion": {"dispersion": 0.5},
        "KHR_materials_diffuse_transmission": {"diffuseTransmissionFactor": 0.5},
    }
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 3, 4]}],
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensionsRequired": ["KHR_texture_transform"],
        "extensions": {"KHR_lights_punctual": {"lights": lights}},
        "nodes": [
            {"mesh": 0, "children": [1, 2], "rotation": [0, 0, 0, 1], "scale": [1, 2, 1], "translation": [0, 0, 0]},
            {"mesh": 1, "extensions": instances},
            {"extensions": {"KHR_lights_punctual": {"light": 0}}, "translation": [0, 1, 1]},
            {"camera": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]},
            {"extensions": {"KHR_lights_punctual": {"light": 1}}},
        ],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 5, "material": 0}]}, {"primitives": [plain]}],
        "materials": [wood, {"emissiveFactor": [1, 0.5, 0], "extensions": glass}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": 33071, "wrapT": 33648, "magFilter": 9729}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1}}],
    }


def glb(picture: bytes) -> bytes:
    """All in one file, with an image."""
    document, data = gltf_parts()
    data += b"\0" * (-len(data) % 4)
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": len(picture)})
    document["images"] = [{"bufferView": 9, "mimeType": "image/png"}]
    document["buffers"] = [{"byteLength": len(data + picture)}]
    return packed_glb(json.dumps(document).encode(), data + picture)


def draco_glb() -> bytes:
    """A square with KHR_draco_mesh_compression."""
    data = DracoPy.encode(SQUARE, np.uint32([[0, 1, 2], [0, 2, 3]]))
    zeros = [{"componentType": 5126, "count": 4, "type": "VEC3"}, {"componentType": 5125, "count": 6, "type": "SCALAR"}]
    packed = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "extensionsRequired": list(packed),
        "accessors": zeros,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "extensions": packed}]}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data)}],
    }
    return packed_glb(json.dumps(document).encode(), data)


def meshopt_glb() -> bytes:
    """A square whose buffer views are compressed by meshoptimizer, with each mode and filter, a morph target and an animation."""
    turn = np.float32([[0, 0, 0, 1], [0, 0.6, 0, 0.8]])
    padded = np.pad(np.tile(np.float32([0, 0, 1]), (4, 1)), ((0, 0), (0, 1)))
    rows = {
        "POSITION": (SQUARE, 12, 5126, "VEC3", {}),
        "NORMAL": (meshopt.encode_filter_oct(padded, 4, 8), 4, 5120, "VEC3", {"filter": "OCTAHEDRAL"}),
        "COLOR_0": (meshopt.encode_filter_color(np.full((4, 4), 0.5), 4, 8), 4, 5121, "VEC4", {"filter": "COLOR"}),
        "indices": (np.uint16([0, 1, 2, 0, 2, 3]), 2, 5123, "SCALAR", {"mode": "TRIANGLES"}),
        "strip": (np.uint32([0, 1, 3, 2]), 4, 5125, "SCALAR", {"mode": "INDICES"}),
        "turn": (meshopt.encode_filter_quat(turn, 8, 12), 8, 5122, "VEC4", {"filter": "QUATERNION"}),
        "delta": (meshopt.encode_filter_exp(0.1 * SQUARE, 16), 12, 5126, "VEC3", {"filter": "EXPONENTIAL"}),
        "times": (np.float32([0, 2]), 4, 5126, "SCALAR", {}),
    }
    data, views, accessors, plain = bytearray(), [], [], 0
    for number, (array, stride, kind, form, values) in enumerate(rows.values()):
        packed = {"buffer": 0, "byteOffset": len(data), "byteStride": stride, "count": len(array), "mode": "ATTRIBUTES", **values}
        encoded = meshopt.encode_gltf_buffer(array, packed["mode"])
        packed["byteLength"] = len(encoded)
        view = {"buffer": 1, "byteOffset": plain, "byteLength": stride * len(array)}
        views.append({**view, "extensions": {"KHR_meshopt_compression": packed}})
        accessors.append({"bufferView": number, "componentType": kind, "count": len(array), "type": form})
        accessors[-1]["normalized"] = kind in (5120, 5121, 5122)
        plain += stride * len(array)
        data += encoded + b"\0" * (-len(encoded) % 4)
    for view in views[1:3]:
        view["byteStride"] = 4
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    moved = {"attributes": attributes, "indices": 3, "targets": [{"POSITION": 6}]}
    channel = {"sampler": 0, "target": {"node": 0, "path": "rotation"}}
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0, "weights": [0.5]}],
        "extensionsRequired": ["KHR_meshopt_compression"],
        "accessors": accessors,
        "meshes": [{"primitives": [moved, {"attributes": {"POSITION": 0}, "indices": 4, "mode": 5}]}],
        "animations": [{"samplers": [{"input": 7, "output": 5}], "channels": [channel]}],
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}, {"byteLength": plain}],
    }
    return packed_glb(json.dumps(document).encode(), bytes(data))


def glossy_gltf() -> dict:
    """The JSON of a file with specular-glossiness and variants; it needs square.bin, wood.png, wood.ktx2 and wood.avif."""
    document, data = gltf_parts()
    gloss = {
        "diffuseFactor": [1, 1, 1, 0.5],
        "diffuseTexture": {"index": 1},
        "specularFactor": [0.2, 0.3, 1],
        "glossinessFactor": 0.6,
        "specularGlossinessTexture": {"index": 2},
    }
    document["materials"][0]["extensions"] = {"KHR_materials_pbrSpecularGlossiness": gloss}
    mappings = [{"material": 1, "variants": [0]}, {"material": 0, "variants": [1]}]
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_materials_variants": {"mappings": mappings}}
    document["extensions"]["KHR_materials_variants"] = {"variants": [{"name": "night"}, {"name": "day"}]}
    named = {"KHR_texture_basisu": {"source": 1}}, {"EXT_texture_avif": {"source": 2}}
    document["textures"] += [{"source": 0, "extensions": extension} for extension in named]
    images = [{"uri": f"wood.{suffix}"} for suffix in ("png", "ktx2", "avif")]
    return document | {"images": images, "buffers": [{"uri": "square.bin", "byteLength": len(data)}]}


def packed_glb(text: bytes, data: bytes) -> bytes:
    text, data = text + b" " * (-len(text) % 4), data + b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
