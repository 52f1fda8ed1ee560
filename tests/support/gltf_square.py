"""A small glTF file for tests, written by hand."""

import base64
import json

import numpy as np

CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
TEXCOORDS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.uint16)


def write_gltf(path, material=None, nodes=None, normals=None, indices=TRIANGLES, corners=CORNERS, **extra):
    """A square of 2 × 2 that faces +z as a glTF with embedded buffers."""
    arrays = {"POSITION": corners, "TEXCOORD_0": TEXCOORDS}
    if normals is not None:
        arrays["NORMAL"] = np.asarray(normals, np.float32)
    blobs = [array.tobytes() for array in arrays.values()] + [indices.tobytes()]
    views, accessors, offset = [], [], 0
    for blob, array in zip(blobs, [*arrays.values(), indices]):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(blob)})
        kind = {2: "VEC2", 3: "VEC3"}[array.shape[1]] if array is not indices else "SCALAR"
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": 5123 if array is indices else 5126,
                "count": indices.size if array is indices else len(array),
                "type": kind,
                "min": array.min(axis=0).tolist() if array is not indices else [int(array.min())],
                "max": array.max(axis=0).tolist() if array is not indices else [int(array.max())],
            }
        )
        offset += len(blob)
    primitive = {
        "attributes": {name: number for number, name in enumerate(arrays)},
        "indices": len(arrays),
        **({} if material is None else {"material": 0}),
    }
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes or [0])))}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [] if material is None else [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [
            {
                "byteLength": offset,
                "uri": "data:application/octet-stream;base64," + base64.b64encode(b"".join(blobs)).decode(),
            }
        ],
    } | extra
    path.write_text(json.dumps(document))
    return str(path)
