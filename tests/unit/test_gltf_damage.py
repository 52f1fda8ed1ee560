"""Damaged glTF files: one line that names the file and the place, whatever is wrong."""

import copy
import json
import struct

import numpy as np
import pytest
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene, summarize, validation
from tests.support.gltf_builder import UVS, Builder, simple


def message(path) -> str:
    with pytest.raises(BokehguideError) as caught:
        load_scene(str(path))
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text
    return text


def rich(tmp_path) -> dict:
    """The JSON of a file that has nearly everything."""
    builder = Builder()
    Image.new("RGB", (1, 1)).save(tmp_path / "i.png")
    texture = builder.texture((tmp_path / "i.png").read_bytes(), sampler=0)
    builder.material(extensions={"KHR_materials_volume": {"thicknessFactor": 1.0}})
    mesh = builder.mesh(TEXCOORD_0=UVS, NORMAL=np.tile(np.float32([0, 0, 1]), (4, 1)), material=0)
    zeros = builder.view(bytes(12))
    places = builder.accessor(np.zeros((2, 3), np.float32))
    builder.node(mesh=mesh, extensions={"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}})
    builder.node(mesh=mesh, rotation=[0, 0, 0, 1], scale=[1, 2, 3])
    builder.lights({"type": "spot", "spot": {"outerConeAngle": 0.5}})
    builder.node(extensions={"KHR_lights_punctual": {"light": 0}}, camera=0)
    builder.save(tmp_path / "rich.gltf")
    document = json.loads((tmp_path / "rich.gltf").read_text())
    document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    document["materials"][0]["pbrMetallicRoughness"] = {
        "baseColorFactor": [1, 1, 1, 1],
        "metallicFactor": 0.5,
        "baseColorTexture": {"index": texture, "texCoord": 0},
    }
    document["samplers"] = [{"wrapS": 10497}]
    document["accessors"][4]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": zeros, "componentType": 5125},
        "values": {"bufferView": zeros},
    }
    return document


def replaced(document: dict, place: str, value: object) -> dict:
    document = copy.deepcopy(document)
    *parents, last = [int(key) if key.isdigit() else key for key in place.split("/")]
    target = document
    for key in parents:
        target = target[key]
    target[last] = value
    return document


@pytest.mark.parametrize(
    ("place", "value", "named"),
    [
        ("accessors/0/count", 40, "accessors[0]: 40 elements of 12 bytes, 12 apart from byte 0 on, reach beyond the 48"),
        ("accessors/0/count", -1, "accessors[0].count: -1 is not a whole number"),
        ("accessors/0/count", 3, "differ in their counts"),
        ("accessors/0/count", 2.5, "accessors[0].count: 2.5"),
        ("accessors/0/count", 10**12, "accessors[0].count: 1000000000000 is not a whole number from 0 to"),
        ("accessors/0/byteOffset", 1, "reach beyond"),
        ("accessors/0/byteOffset", -4, "byteOffset: -4"),
        ("accessors/0/componentType", 5124, "componentType: 5124 is none of"),
        ("accessors/0/type", "VEC2", "'VEC2' is not VEC3"),
        ("accessors/0/type", None, "accessors[0].type: missing"),
        ("accessors/0/bufferView", 99, "bufferView: 99 is no index into bufferViews"),
        ("bufferViews/1/byteLength", 10**6, "byteLength: 1000000 from byte"),
        ("bufferViews/1/byteStride", 4, "byteStride: 4 is less than the 12 bytes"),
        ("bufferViews/1/buffer", 1, "buffer: 1 is no index"),
        ("bufferViews/1/buffer", None, "buffer: missing"),
        ("buffers/0/byteLength", 10**6, "byteLength: 1000000 is more than"),
        ("buffers/0/uri", None, "buffers[0]: has no data"),
        ("buffers/0/uri", "data:;base64,A", "buffers[0].uri"),
        ("buffers/0/uri", "gone.bin", "no file beside the model"),
        ("buffers/0/uri", "nul\0", "buffers[0].uri"),
        ("accessors/4/sparse/count", 9, "sparse.count: 9 is not a whole number from 0 to 2"),
        ("accessors/4/sparse/indices/componentType", 5126, "is not an unsigned integer"),
        ("accessors/4/sparse/values", {}, "sparse.values.bufferView: missing"),
        ("accessors/3/componentType", 5122, "accessors[3].componentType: 5122 is not an unsigned integer"),
        ("accessors/3/count", 5, "5 indices are no whole number of triangles"),
        ("meshes/0/primitives/0/attributes/POSITION", 77, "POSITION: 77 is no index into accessors"),
        ("meshes/0/primitives/0/material", 5, "material: 5 is no index into materials"),
        ("meshes/0/primitives", 5, "primitives: 5 is not a list"),
        ("meshes/0", 5, "meshes[0]: 5 is not a JSON object"),
        ("nodes/0/mesh", "a", "nodes[0].mesh: 'a' is not a whole number"),
        ("nodes/0/children", [0], "its own ancestor"),
        ("nodes/0/children", [1], "nodes[1]: has two parents"),
        ("nodes/0/children", ["x"], "nodes[0].children.0: 'x'"),
        ("nodes/0/matrix", [1, 2], "matrix: [1, 2] is not a list of 16 numbers"),
        ("nodes/1/rotation", [0, 0, 0, 0], "rotation: [0, 0, 0, 0] is not a rotation"),
        ("nodes/1/scale", [1, float("nan"), 1], "nodes[1].scale"),
        ("nodes/0/extensions/EXT_mesh_gpu_instancing/attributes", {}, "counts must agree (none)"),
        ("nodes/2/extensions/KHR_lights_punctual/light", 4, "light: 4 is no index into the file's 1 lights"),
        ("nodes/2/camera", 4, "camera: 4 is no index"),
        ("cameras/0/perspective/yfov", 4, "yfov: 4 is out of range"),
        ("cameras/0/perspective", {}, "yfov: missing"),
        ("scene", 3, "scene: 3 is no index into scenes"),
        ("scenes/0/nodes", {}, "scenes[0].nodes: {} is not a list of indices"),
        ("materials/0/alphaMode", "CLEAR", "alphaMode: 'CLEAR' is none of OPAQUE, MASK, BLEND"),
        ("materials/0/pbrMetallicRoughness", 7, "materials[0].pbrMetallicRoughness: 7 is not a JSON object"),
        ("materials/0/pbrMetallicRoughness/baseColorTexture/index", 7, "index: 7 is no index into textures"),
        ("materials/0/pbrMetallicRoughness/baseColorTexture/texCoord", 99, "texCoord: 99"),
        ("materials/0/extensions/KHR_materials_volume/attenuationDistance", 0, "attenuationDistance: 0 is out of range"),
        ("textures/0/source", 7, "source: 7 is no index into images"),
        ("images/0", {}, "images[0]: has neither bufferView nor uri"),
        ("samplers/0/wrapS", 7, "wrapS: 7 is none of"),
        ("extensionsRequired", "KHR", "extensionsRequired: 'KHR' is not a list of strings"),
        ("asset/version", "1.0", "asset.version: '1.0' is not glTF 2"),
    ],
)
def test_a_damaged_file(tmp_path, place, value, named):
    document = rich(tmp_path)
    path = tmp_path / "bad.gltf"
    path.write_text(json.dumps(document))
    load_scene(str(path))
    path.write_text(json.dumps(replaced(document, place, value)))
    assert named in message(path)


@pytest.mark.slow
def test_no_damage_is_a_traceback(tmp_path):
    """Every value of a file, one after the other, is replaced by an invalid value."""
    document = rich(tmp_path)
    path = tmp_path / "bad.gltf"
    refused = 0
    for place in list(places(document)):
        for value in (None, -1, 1e300, "x", [None], {}):
            path.write_text(json.dumps(replaced(document, place, value)))
            try:
                load_scene(str(path))
            except BokehguideError as error:
                refused += 1
                assert str(error).startswith((str(path), "--")) and "\n" not in str(error), (place, value)
    assert refused > 300


def places(value: object, path: str = ""):
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in entries:
        here = f"{path}/{key}" if path else str(key)
        yield here
        yield from places(child, here)


def test_names_do_nothing_to_the_terminal(tmp_path):
    """Names in errors, warnings and the import report are one printable line."""
    document, name = rich(tmp_path), "\x1b[2J\n" + "x" * 500
    for section in ("nodes", "meshes", "materials", "cameras", "textures"):
        for part in document[section]:
            part["name"] = name
    document |= {"extensionsUsed": [name], "animations": [{}]}
    document["materials"][0]["extensions"][name] = {}
    document["nodes"][2] |= {"name": None}
    path = tmp_path / "bad.gltf"
    path.write_text(json.dumps(document))
    scene = load_scene(str(path))
    told = [*summarize(scene).splitlines(), *scene.warnings, *scene.supported]
    assert all(line.isprintable() and len(line) < 600 for line in told), told
    for place, value in (("extensionsRequired", [name]), ("nodes/0/mesh", name), (f"meshes/0/{name}", 1), ("nodes/1/scale", 0)):
        path.write_text(json.dumps(replaced(document, place, value)))
        if name not in place:
            assert message(path).isprintable()


def test_a_compression_that_is_not_read(tmp_path):
    """With a fallback, as the extension allows, the file is readable; without one its buffer is empty."""
    path = tmp_path / "packed.gltf"
    document = rich(tmp_path)
    document["bufferViews"][1]["extensions"] = {"X_packing": {}}
    path.write_text(json.dumps(document | {"extensionsUsed": ["X_packing"]}))
    assert "packed.gltf: X_packing: has no effect" in load_scene(str(path)).warnings
    document["buffers"].append({"byteLength": 48})
    path.write_text(json.dumps(replaced(document, "bufferViews/1/buffer", 1)))
    assert "buffers[1]: has no data, and X_packing is not read; save" in message(path)


def test_a_glb_that_is_cut_or_of_another_version(tmp_path):
    path = tmp_path / "cut.glb"
    simple().save(path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        message(path)
    path.write_bytes(whole[:-20])
    assert "cut short" in message(path)
    path.write_bytes(whole[:4] + struct.pack("<I", 1) + whole[8:])
    assert "no GLB of version 2" in message(path)


def test_noise_in_a_glb(tmp_path):
    path = tmp_path / "noise.glb"
    simple(TEXCOORD_0=UVS).save(path)
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    rng = np.random.default_rng(7)
    for _ in range(300):
        noisy = whole.copy()
        where = rng.integers(0, len(noisy), 3)
        noisy[where] = rng.integers(0, 256, 3)
        path.write_bytes(noisy.tobytes())
        try:
            load_scene(str(path))
        except BokehguideError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error)


def test_many_primitives_of_one_buffer_are_counted_as_they_are_read(tmp_path, monkeypatch):
    """Each makes its own copy: a short list of them would fill the memory before the scene is whole."""
    document = rich(tmp_path)
    document["meshes"][0]["primitives"] *= 50
    path = tmp_path / "many.gltf"
    path.write_text(json.dumps(document))
    monkeypatch.setattr(validation, "MAX_TRIANGLES", 60)
    with pytest.raises(BokehguideError, match=r"meshes\[0\].primitives\[30\]: makes 62 triangles in all"):
        load_scene(str(path))


def test_so_are_the_spheres_of_lights(tmp_path, monkeypatch):
    document = rich(tmp_path)
    document["nodes"] += [document["nodes"][2]] * 20
    document["scenes"][0]["nodes"] += range(3, 23)
    path = tmp_path / "many.gltf"
    path.write_text(json.dumps(document))
    monkeypatch.setattr(validation, "MAX_TRIANGLES", 5 * 1280)
    with pytest.raises(BokehguideError, match=r"nodes\[7\]: makes 7,680 triangles in all"):
        load_scene(str(path))


@pytest.mark.parametrize("sparse", [True, False])
def test_zeros_that_no_file_holds_are_few(tmp_path, sparse):
    document = replaced(rich(tmp_path), "accessors/4/count", 2**20 + 1)
    del document["accessors"][4]["bufferView"]
    if not sparse:
        del document["accessors"][4]["sparse"]
    (tmp_path / "bad.gltf").write_text(json.dumps(document))
    assert "accessors[4].count: 1048577 is not a whole number from 0 to 1048576" in message(tmp_path / "bad.gltf")


def test_triangles_without_a_vertex(tmp_path):
    document = rich(tmp_path)
    for number in (0, 1, 2):
        document["accessors"][number]["count"] = 0
    (tmp_path / "bad.gltf").write_text(json.dumps(document))
    assert "there are 0 vertices" in message(tmp_path / "bad.gltf")
