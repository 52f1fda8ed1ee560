"""EXT_meshopt_compression and KHR_meshopt_compression, with files that meshoptimizer itself compresses."""

import meshopt
import numpy as np
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.limits import MAX_DECODED
from bokehguide.scene import load_scene
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.summary import summarize
from tests.support.gltf_builder import INDICES, SQUARE, Builder

EXT, KHR = "EXT_meshopt_compression", "KHR_meshopt_compression"
TURN = np.array([0.0, np.sin(0.4), 0.0, np.cos(0.4)], np.float32)
"""A quaternion of 0.8 radians about +y."""


def attributes(array: np.ndarray, version: int = 0) -> bytes:
    return meshopt.encode_vertex_buffer_level(array, 2, version)


def padded(array: np.ndarray) -> np.ndarray:
    """Rows of four numbers, as the filters take them."""
    return np.pad(array, ((0, 0), (0, 4 - array.shape[1]))).astype(np.float32)


def packed_square(name: str = EXT, version: int = 0, **values: object) -> Builder:
    """A square whose positions and indices are compressed. values: changes of the extension of the positions."""
    builder = Builder()
    positions = builder.packed(attributes(SQUARE, version), 4, 12, name, **({"mode": "ATTRIBUTES"} | values))
    triangles = builder.packed(meshopt.encode_gltf_buffer(INDICES, "TRIANGLES"), 6, 2, name, mode="TRIANGLES")
    mesh = builder.mesh(
        POSITION=builder.accessor(SQUARE, bufferView=positions), indices=builder.accessor(INDICES, bufferView=triangles)
    )
    builder.node(mesh=mesh)
    builder.gltf.extensionsRequired.append(name)
    return builder


@pytest.mark.parametrize(("name", "version"), [(EXT, 0), (KHR, 0), (KHR, 1)])
def test_positions_and_triangles(tmp_path, name, version):
    scene = load_scene(packed_square(name, version).save(tmp_path / "packed.glb"))
    (mesh,) = scene.meshes
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    assert sorted(map(sorted, mesh.triangles.tolist())) == [[0, 1, 2], [0, 2, 3]]
    a, b, c = mesh.vertices[mesh.triangles[0]]
    assert np.cross(b - a, c - a)[2] > 0.0
    assert scene.warnings == () and "buffer views compressed by meshoptimizer: 2" in summarize(scene)


def test_indices_of_a_strip(tmp_path):
    builder = Builder()
    order = np.array([0, 1, 3, 2], np.uint32)
    view = builder.packed(meshopt.encode_gltf_buffer(order, "INDICES"), 4, 4, mode="INDICES")
    builder.node(mesh=builder.mesh(indices=builder.accessor(order, bufferView=view), mode=5))
    (mesh,) = load_scene(builder.save(tmp_path / "strip.glb")).meshes
    assert sorted(map(sorted, mesh.triangles.tolist())) == [[0, 1, 3], [1, 2, 3]]


def test_octahedral_normals_and_exponential_positions(tmp_path):
    builder = Builder()
    normals = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, -0.8, 0.6], [0.48, 0.6, 0.64]], np.float32)
    rows = {
        "NORMAL": meshopt.encode_filter_oct(padded(normals), 8, 16),
        "POSITION": meshopt.encode_filter_exp(SQUARE * 0.3, 20),
    }
    views = {
        "NORMAL": builder.packed(attributes(rows["NORMAL"]), 4, 8, mode="ATTRIBUTES", filter="OCTAHEDRAL"),
        "POSITION": builder.packed(attributes(rows["POSITION"]), 4, 12, mode="ATTRIBUTES", filter="EXPONENTIAL"),
    }
    builder.gltf.bufferViews[views["NORMAL"]].byteStride = 8
    number = builder.accessor(normals.astype(np.int16), bufferView=views["NORMAL"], normalized=True)
    builder.node(mesh=builder.mesh(NORMAL=number, POSITION=builder.accessor(SQUARE, bufferView=views["POSITION"])))
    (mesh,) = load_scene(builder.save(tmp_path / "filters.glb")).meshes
    np.testing.assert_allclose(mesh.normals, normals, atol=2e-4)
    np.testing.assert_allclose(mesh.vertices, SQUARE * 0.3, atol=1e-6)


def test_quaternions_of_instances(tmp_path):
    """Compressed as viewers' instances are: normalised 16-bit rotations."""
    builder = Builder()
    quaternions = np.array([[0, 0, 0, 1], TURN], np.float32)
    rows = meshopt.encode_filter_quat(quaternions, 8, 12)
    view = builder.packed(attributes(rows), 2, 8, mode="ATTRIBUTES", filter="QUATERNION")
    rotation = builder.accessor(quaternions.astype(np.int16), bufferView=view, normalized=True)
    builder.node(mesh=builder.mesh(), extensions={"EXT_mesh_gpu_instancing": {"attributes": {"ROTATION": rotation}}})
    (mesh,) = load_scene(builder.save(tmp_path / "turned.glb")).meshes
    np.testing.assert_allclose(mesh.vertices[:4], SQUARE, atol=2e-3)
    turned = np.stack([SQUARE[:, 0] * np.cos(0.8), SQUARE[:, 1], -SQUARE[:, 0] * np.sin(0.8)], axis=1)
    np.testing.assert_allclose(mesh.vertices[4:], turned, atol=2e-3)


def test_colours_of_the_newer_extension(tmp_path):
    colors = np.array([[1, 0, 0, 1], [0, 1, 0, 0.5], [0.2, 0.4, 0.6, 0.8], [1, 1, 1, 1]], np.float32)
    rows = meshopt.encode_filter_color(colors, 8, 16)

    def built(name: str) -> str:
        builder = Builder()
        view = builder.packed(attributes(rows), 4, 8, name, mode="ATTRIBUTES", filter="COLOR")
        number = builder.accessor((colors * 65535).astype(np.uint16), bufferView=view, normalized=True)
        builder.node(mesh=builder.mesh(COLOR_0=number))
        return builder.save(tmp_path / f"{name}.glb")

    (mesh,) = load_scene(built(KHR)).meshes
    np.testing.assert_allclose(mesh.colors, colors, atol=1e-3)
    with pytest.raises(BokehguideError, match="filter: 'COLOR' is none of NONE, OCTAHEDRAL, QUATERNION, EXPONENTIAL"):
        load_scene(built(EXT))


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"mode": "STRIPS"}, "mode: 'STRIPS' is none of ATTRIBUTES, TRIANGLES, INDICES"),
        ({"filter": "ZIP"}, "filter: 'ZIP' is none of NONE"),
        ({"filter": "QUATERNION"}, "byteStride: 12 does not suit the mode ATTRIBUTES with the filter QUATERNION"),
        ({"mode": "TRIANGLES", "filter": "OCTAHEDRAL"}, "filter: 'OCTAHEDRAL' needs the mode ATTRIBUTES"),
        ({"mode": "TRIANGLES"}, "byteStride: 12 does not suit the mode TRIANGLES"),
        ({"count": 5}, r"bufferViews\[0\]\.byteLength: 48 is not 5 elements of 12 bytes"),
        ({"count": None}, "count: missing"),
        ({"byteStride": 6}, "byteStride: 6 does not suit"),
        ({"byteLength": 10**6}, r"byteLength: 1000000 from byte 0 on is beyond its buffer's"),
        ({"byteOffset": 3}, "beyond its buffer's|damaged data"),
        ({"byteLength": 20}, "damaged data .*; fetch the file again"),
        ({"buffer": 7}, "buffer: 7 is no index into buffers"),
        ({"buffer": 1, "byteOffset": 0}, r"buffers\[1\]: has no data"),
    ],
)
def test_damaged_compression(tmp_path, values, named):
    with pytest.raises(BokehguideError, match=rf"bad\.glb: .*{named}") as caught:
        load_scene(packed_square(**values).save(tmp_path / "bad.glb"))
    assert "\n" not in str(caught.value)


def test_few_bytes_that_claim_to_be_many(tmp_path):
    builder = packed_square()
    view = builder.gltf.bufferViews[0]
    view.byteLength, view.extensions[EXT]["count"] = 12 * 10**8, 10**8
    with pytest.raises(BokehguideError, match=r"count: 100000000 needs more than the \d+ bytes of compressed data"):
        load_scene(builder.save(tmp_path / "bomb.glb"))


def test_the_memory_of_all_views_is_bounded(tmp_path):
    files = SceneFiles(tmp_path)
    files.reserve_decoded(MAX_DECODED, 1000, "a.glb")
    with pytest.raises(BokehguideError, match=r"a\.glb: the scene's buffers would decode from 2,000 to 134,.* bytes"):
        files.reserve_decoded(64 * 2000 + 1, 1000, "a.glb")


def test_a_view_is_decoded_once(tmp_path, monkeypatch):
    calls = []
    decode = meshopt.decode_gltf_buffer
    monkeypatch.setattr(meshopt, "decode_gltf_buffer", lambda *given: calls.append(given) or decode(*given))
    builder = packed_square()
    builder.gltf.nodes.append(builder.gltf.nodes[0])
    builder.gltf.meshes[0].primitives *= 3
    assert len(load_scene(builder.save(tmp_path / "packed.glb")).meshes) == 3
    assert len(calls) == 2
