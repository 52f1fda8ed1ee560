"""glTF files for tests, written by pygltflib."""

from __future__ import annotations

import numpy as np
import pygltflib
from fuzzing.gltf_samples import packed_glb

TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
INDICES = np.array([0, 1, 2, 0, 2, 3], np.uint16)


class Builder:
    """A glTF document and its one buffer; what is appended gets the next index."""

    def __init__(self) -> None:
        self.gltf = pygltflib.GLTF2(scene=0, scenes=[pygltflib.Scene(nodes=[])])
        self.data = bytearray()
        self.placeholder = 0
        """Bytes of a second buffer without data, to which compressed views refer."""

    def view(self, data: bytes, stride: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = pygltflib.BufferView(buffer=0, byteOffset=len(self.data), byteLength=len(data), byteStride=stride)
        self.gltf.bufferViews.append(view)
        self.data += data
        return len(self.gltf.bufferViews) - 1

    def packed(self, data: bytes, count: int, stride: int, name: str = "EXT_meshopt_compression", /, **values: object) -> int:
        """A view of `count` elements of `stride` bytes, compressed to `data`; values: of the extension."""
        number = self.view(data)
        view = self.gltf.bufferViews[number]
        extension = {"buffer": 0, "byteOffset": view.byteOffset, "byteLength": len(data), "byteStride": stride, "count": count}
        view.buffer, view.byteOffset, view.byteLength = 1, self.placeholder, count * stride
        view.extensions = {name: extension | values}
        self.placeholder += count * stride
        return number

    def accessor(self, array: np.ndarray, normalized: bool = False, **changes: object) -> int:
        """`[N]` or `[N, width]`, tightly packed."""
        array = np.ascontiguousarray(array)
        rows = array.reshape(len(array), -1)
        values = {
            "bufferView": self.view(array.tobytes()),
            "componentType": COMPONENTS[array.dtype.str[1:]],
            "normalized": normalized,
            "count": len(array),
            "type": TYPES[rows.shape[1]],
        }
        self.gltf.accessors.append(pygltflib.Accessor(**(values | changes)))
        return len(self.gltf.accessors) - 1

    def mesh(self, indices: np.ndarray | None = INDICES, mode: int = 4, material: int | None = None, **arrays) -> int:
        """One primitive; `arrays` are attributes, or numbers of accessors. By default a square of 2 × 2."""
        attributes = {"POSITION": SQUARE} | arrays
        numbers = {k: v if isinstance(v, int) else self.accessor(v) for k, v in attributes.items() if v is not None}
        primitive = pygltflib.Primitive(
            attributes=pygltflib.Attributes(**numbers),
            indices=indices if indices is None or isinstance(indices, int) else self.accessor(indices),
            mode=mode,
            material=material,
        )
        self.gltf.meshes.append(pygltflib.Mesh(primitives=[primitive]))
        return len(self.gltf.meshes) - 1

    def node(self, root: bool = True, **values: object) -> int:
        self.gltf.nodes.append(pygltflib.Node(**values))
        if root:
            self.gltf.scenes[0].nodes.append(len(self.gltf.nodes) - 1)
        return len(self.gltf.nodes) - 1

    def material(self, pbr: dict | None = None, **values: object) -> int:
        pbr = pygltflib.PbrMetallicRoughness(**(pbr or {}))
        self.gltf.materials.append(pygltflib.Material(pbrMetallicRoughness=pbr, **values))
        return len(self.gltf.materials) - 1

    def texture(self, png: bytes, sampler: int | None = None) -> int:
        self.gltf.images.append(pygltflib.Image(bufferView=self.view(png), mimeType="image/png"))
        self.gltf.textures.append(pygltflib.Texture(source=len(self.gltf.images) - 1, sampler=sampler))
        return len(self.gltf.textures) - 1

    def lights(self, *lights: dict) -> None:
        self.gltf.extensionsUsed.append("KHR_lights_punctual")
        self.gltf.extensions["KHR_lights_punctual"] = {"lights": list(lights)}

    def save(self, path) -> str:
        """Write `path`, a `.glb` or a `.gltf` with a data URI."""
        self.gltf.buffers = [pygltflib.Buffer(byteLength=len(self.data))]
        if self.placeholder:  # pygltflib would fill the second buffer
            self.gltf.buffers.append(pygltflib.Buffer(byteLength=self.placeholder))
            path.write_bytes(packed_glb(self.gltf.to_json().encode(), bytes(self.data)))
            return str(path)
        self.gltf.set_binary_blob(bytes(self.data))
        if path.suffix == ".gltf":
            self.gltf.convert_buffers(pygltflib.BufferFormat.DATAURI)
        self.gltf.save(str(path))
        return str(path)


def simple(**mesh: object) -> Builder:
    """One node with one mesh."""
    builder = Builder()
    builder.node(mesh=builder.mesh(**mesh))
    return builder
