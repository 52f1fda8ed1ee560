"""glTF geometry: accessors in every form, triangle modes, the node tree, instances."""

import json

import numpy as np
import pygltflib
import pytest

from bokehguide import limits
from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene, validation
from bokehguide.scene.shapes import unit_normals
from tests.support.gltf_builder import INDICES, SQUARE, UVS, Builder, simple

QUARTER_TURN = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
"""A quarter turn about z: x becomes y."""


def only_mesh(builder, path):
    (mesh,) = load_scene(builder.save(path)).meshes
    return mesh


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_a_square(tmp_path, suffix):
    colors = np.arange(16, dtype=np.float32).reshape(4, 4) / 16
    mesh = only_mesh(simple(TEXCOORD_0=UVS, COLOR_0=colors), tmp_path / f"square.{suffix}")
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.triangles, INDICES.reshape(2, 3))
    np.testing.assert_array_equal(mesh.uvs[:, 0], UVS)
    np.testing.assert_array_equal(mesh.colors, colors)
    assert mesh.vertices.dtype == np.float32 and mesh.triangles.dtype == np.int32 and mesh.normals is None


def test_buffers_in_files(tmp_path):
    path = tmp_path / "square.gltf"
    builder = simple()
    builder.save(path)
    document = json.loads(path.read_text())
    document["buffers"][0]["uri"] = "my%20data.bin"
    path.write_text(json.dumps(document))
    with pytest.raises(BokehguideError, match=r"square\.gltf: buffers\[0\]\.uri: 'my%20data\.bin' is no file beside"):
        load_scene(str(path))
    (tmp_path / "my data.bin").write_bytes(builder.data)
    np.testing.assert_array_equal(load_scene(str(path)).meshes[0].vertices, SQUARE)


@pytest.mark.parametrize(
    ("dtype", "normalized", "stored", "meant"),
    [
        ("i1", True, [127, -127, -128], [1.0, -1.0, -1.0]),
        ("u1", True, [255, 0, 51], [1.0, 0.0, 0.2]),
        ("i2", True, [32767, -32768, 0], [1.0, -1.0, 0.0]),
        ("u2", True, [65535, 0, 13107], [1.0, 0.0, 0.2]),
        ("i2", False, [300, -2, 0], [300.0, -2.0, 0.0]),
        ("u1", False, [7, 200, 0], [7.0, 200.0, 0.0]),
    ],
)
def test_quantised_positions(tmp_path, dtype, normalized, stored, meant):
    builder = Builder()
    corners = np.zeros((4, 4), dtype)  # elements of three, four apart, as the format wants them aligned
    corners[:3, 0], corners[3, 1] = stored, 1
    view = builder.view(corners.tobytes(), stride=4 * corners.itemsize)
    number = builder.accessor(corners[:, :3], normalized, bufferView=view)
    builder.gltf.extensionsRequired.append("KHR_mesh_quantization")
    builder.node(mesh=builder.mesh(POSITION=number, indices=np.array([0, 1, 3, 1, 2, 3], np.uint8)))
    np.testing.assert_allclose(only_mesh(builder, tmp_path / "small.glb").vertices[:3, 0], meant, rtol=1e-6)


@pytest.mark.parametrize(
    ("colors", "meant"),
    [
        (np.array([[255, 51, 0, 102]] * 4, np.uint8), [1.0, 0.2, 0.0, 0.4]),
        (np.array([[65535, 13107, 0]] * 4, np.uint16), [1.0, 0.2, 0.0, 1.0]),
        (np.array([[2.0, 0.5, -0.25]] * 4, np.float32), [1.0, 0.5, 0.0, 1.0]),
    ],
)
def test_vertex_colours(tmp_path, colors, meant):
    np.testing.assert_allclose(only_mesh(simple(COLOR_0=colors), tmp_path / "c.glb").colors, [meant] * 4, rtol=1e-6)


@pytest.mark.parametrize(("line", "kept"), [('material = "clay"', False), ("", True)])
def test_a_material_in_a_models_place_leaves_no_vertex_colours(tmp_path, line, kept):
    simple(COLOR_0=np.full((4, 4), 0.5, np.float32)).save(tmp_path / "square.glb")
    scene = tmp_path / "scene.toml"
    scene.write_text(
        "[camera]\nposition = [0, 0, 3]\ntarget = [0, 0, 0]\nfov = 40\naperture_radius = 0.1\nfocus_distance = 3\n"
        f'[materials.clay]\nbase_color = [1, 1, 1]\n[[object]]\nfile = "square.glb"\n{line}\n'
    )
    (mesh,) = load_scene(str(scene)).meshes
    assert (mesh.colors is not None) == kept


def test_interleaved_and_sparse(tmp_path):
    builder = Builder()
    both = np.concatenate([SQUARE, UVS], axis=1)
    view = builder.view(both.tobytes(), stride=20)
    moved, where = np.array([[5, 6, 7]], np.float32), np.array([2], np.uint8)
    sparse = pygltflib.Sparse(
        count=1,
        indices=pygltflib.AccessorSparseIndices(bufferView=builder.view(where.tobytes()), componentType=5121),
        values=pygltflib.AccessorSparseValues(bufferView=builder.view(moved.tobytes())),
    )
    positions = builder.accessor(SQUARE, bufferView=view, sparse=sparse)
    builder.node(mesh=builder.mesh(POSITION=positions, TEXCOORD_0=builder.accessor(UVS, bufferView=view, byteOffset=12)))
    mesh = only_mesh(builder, tmp_path / "mixed.glb")
    np.testing.assert_array_equal(mesh.vertices, [SQUARE[0], SQUARE[1], moved[0], SQUARE[3]])
    np.testing.assert_array_equal(mesh.uvs[:, 0], UVS)


def test_sparse_alone_is_zero_elsewhere(tmp_path):
    builder = Builder()
    sparse = pygltflib.Sparse(
        count=2,
        indices=pygltflib.AccessorSparseIndices(bufferView=builder.view(b"\1\2"), componentType=5121),
        values=pygltflib.AccessorSparseValues(bufferView=builder.view(SQUARE[1:3].tobytes())),
    )
    positions = builder.accessor(SQUARE, bufferView=None, sparse=sparse)
    builder.node(mesh=builder.mesh(POSITION=positions, indices=np.array([0, 1, 2], np.uint8)))
    vertices = only_mesh(builder, tmp_path / "sparse.glb").vertices
    np.testing.assert_array_equal(vertices, [(0, 0, 0), SQUARE[1], SQUARE[2]])


@pytest.mark.parametrize(
    ("mode", "indices", "triangles"),
    [
        (4, None, [(0, 1, 2), (3, 4, 5)]),
        (5, None, [(0, 1, 2), (1, 3, 2), (2, 3, 4), (3, 5, 4)]),
        (6, None, [(1, 2, 0), (2, 3, 0), (3, 4, 0), (4, 5, 0)]),
        (5, [5, 4, 3, 0], [(5, 4, 3), (4, 0, 3)]),
        (6, [5, 4, 3, 0], [(4, 3, 5), (3, 0, 5)]),
    ],
)
def test_triangle_modes(tmp_path, mode, indices, triangles):
    points = np.random.default_rng(3).normal(size=(6, 3)).astype(np.float32)
    builder = simple(POSITION=points, mode=mode, indices=None if indices is None else np.array(indices, np.uint32))
    mesh = only_mesh(builder, tmp_path / "mode.glb")
    np.testing.assert_array_equal(mesh.vertices[mesh.triangles], points[np.array(triangles)])


def test_points_and_lines_cause_a_warning(tmp_path):
    builder = simple()
    for mode in (0, 1):
        builder.node(mesh=builder.mesh(mode=mode))
    scene = load_scene(builder.save(tmp_path / "points.glb"))
    assert len(scene.meshes) == 1
    assert scene.warnings == ("points.glb: points and lines: left out (meshes[1], meshes[2])",)


def test_primitives_of_a_shared_vertex_buffer_keep_only_their_own(tmp_path):
    points = np.random.default_rng(5).normal(size=(100, 3)).astype(np.float32)
    mesh = only_mesh(simple(POSITION=points, indices=np.array([90, 7, 33], np.uint8)), tmp_path / "shared.glb")
    assert len(mesh.vertices) == 3
    np.testing.assert_array_equal(mesh.vertices[mesh.triangles[0]], points[[90, 7, 33]])


def test_nodes_in_matrices_and_parts(tmp_path):
    """A child with a matrix below a parent with translation, rotation and scale: T R S M."""
    builder = Builder()
    matrix = np.array([[1, 0.5, 0, 4], [0, 1, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]])
    child = builder.node(root=False, mesh=builder.mesh(), matrix=matrix.T.ravel().tolist())
    builder.node(children=[child], translation=[10, 20, 30], rotation=QUARTER_TURN, scale=[2, 3, 4])
    x, y, z = (SQUARE @ matrix[:3, :3].T + matrix[:3, 3]).T * [[2], [3], [4]]
    np.testing.assert_allclose(
        only_mesh(builder, tmp_path / "tree.glb").vertices, np.stack([10 - y, 20 + x, 30 + z], axis=1), rtol=1e-6
    )


@pytest.mark.parametrize("coat", [False, True])
def test_a_mirror_keeps_front_and_bitangent(tmp_path, coat):
    """Tangents are there for a normal map of either layer."""
    builder = Builder()
    normals, tangents = np.tile(np.float32([0, 0, 2]), (4, 1)), np.tile(np.float32([1, 0, 0, 1]), (4, 1))
    texture = builder.texture(png())
    clearcoat = {"KHR_materials_clearcoat": {"clearcoatFactor": 1, "clearcoatNormalTexture": {"index": texture}}}
    normal = pygltflib.NormalMaterialTexture(index=texture)
    material = builder.material(**{"extensions": clearcoat} if coat else {"normalTexture": normal})
    mesh = builder.mesh(NORMAL=normals, TANGENT=tangents, TEXCOORD_0=UVS, material=material)
    builder.node(mesh=mesh, scale=[-1, 1, 1])
    loaded = only_mesh(builder, tmp_path / "mirror.glb")
    np.testing.assert_array_equal(loaded.normals, [[0, 0, 1]] * 4)
    np.testing.assert_array_equal(loaded.tangents, [[-1, 0, 0, -1]] * 4)
    bitangent = np.cross(loaded.normals[0], loaded.tangents[0, :3]) * loaded.tangents[0, 3]
    np.testing.assert_array_equal(bitangent, [0, 1, 0], "mirrored in x, y stays")
    a, b, c = loaded.vertices[loaded.triangles[0]]
    assert np.cross(b - a, c - a)[2] > 0.0


def png() -> bytes:
    from io import BytesIO

    from PIL import Image

    file = BytesIO()
    Image.new("RGB", (2, 2), (128, 128, 255)).save(file, "PNG")
    return file.getvalue()


def test_a_zero_normal_becomes_that_of_its_faces_with_a_warning(tmp_path):
    tilted = np.array([0.6, 0.0, 0.8], np.float32)
    normals = np.stack((tilted, tilted, tilted, np.zeros(3, np.float32)))
    scene = load_scene(simple(NORMAL=normals).save(tmp_path / "zero.glb"))
    np.testing.assert_allclose(scene.meshes[0].normals, (tilted, tilted, tilted, (0.0, 0.0, 1.0)), atol=1e-6)
    assert scene.warnings == ("zero.glb: normals of length 0: 1 computed from the surrounding faces (meshes[0])",)


def test_a_normal_without_direction_of_an_obj(tmp_path):
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
    normals = "vn 0.6 0 0.8\nvn 0.6 0 0.8\nvn 0.6 0 0.8\nvn 0 0 0\n"
    (tmp_path / "zero.obj").write_text(f"{corners}{normals}f 1//1 2//2 3//3\nf 1//1 3//3 4//4\n")
    found = load_scene(str(tmp_path / "zero.obj")).meshes[0].normals
    np.testing.assert_allclose(found, [(0.6, 0.0, 0.8)] * 3 + [(0.0, 0.0, 1.0)], atol=1e-6)


def test_normals_by_area_of_the_faces_around():
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 1], [5, 5, 5]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    found = unit_normals(np.zeros((5, 3), np.float32), vertices, triangles)
    np.testing.assert_allclose(found[0], np.array((1.0, 0.0, 2.0)) / np.sqrt(5.0), atol=1e-6)
    np.testing.assert_allclose(found[1], (0.0, 0.0, 1.0), atol=1e-6)
    assert not found[4].any()


def test_only_the_default_scene_is_drawn(tmp_path):
    builder = simple()
    other = builder.node(root=False, mesh=0, translation=[0, 0, 9])
    builder.gltf.scenes.append(pygltflib.Scene(name="other", nodes=[other]))
    builder.gltf.scene = 1
    scene = load_scene(builder.save(tmp_path / "two.glb"))
    assert [mesh.vertices[0, 2] for mesh in scene.meshes] == [9.0]
    assert scene.warnings == ("two.glb: scenes: only other of 2 is drawn",)


def instancing(builder: Builder, **attributes) -> dict:
    numbers = {name: builder.accessor(values, values.dtype != np.float32) for name, values in attributes.items()}
    return {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": numbers}}}


def test_instances(tmp_path):
    builder = Builder()
    places = np.array([[1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    turns = np.array([[0, 0, 0, 32767], np.multiply(QUARTER_TURN, 32767).round(), [0, 0, 0, 32767]], np.int16)
    sizes = np.array([[1, 1, 1], [2, 2, 2], [-1, 1, 1]], np.float32)
    placed = instancing(builder, TRANSLATION=places, ROTATION=turns, SCALE=sizes)
    builder.node(mesh=builder.mesh(), translation=[100, 0, 0], **placed)
    mesh = only_mesh(builder, tmp_path / "many.glb")
    x, y, z = SQUARE.T
    wanted = [SQUARE + places[0], np.stack([-2 * y, 2 * x + 2, z], axis=1), SQUARE * [-1, 1, 1] + places[2]]
    np.testing.assert_allclose(mesh.vertices, np.concatenate(wanted) + [100, 0, 0], atol=1e-3)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all(), "each faces +z, the mirrored one too"


def test_too_many_instances_are_refused_before_they_are_made(tmp_path, monkeypatch):
    builder = Builder()
    builder.node(mesh=builder.mesh(), **instancing(builder, TRANSLATION=np.zeros((6, 3), np.float32)))
    path = builder.save(tmp_path / "many.glb")
    assert limits.MAX_TRIANGLES == validation.MAX_TRIANGLES >= 10**7
    monkeypatch.setattr(validation, "MAX_TRIANGLES", 11)
    with pytest.raises(BokehguideError, match=r"many\.glb: nodes.*: makes 12 triangles in all; .* at most 11"):
        load_scene(path)


def test_instances_of_no_size_are_left_out(tmp_path):
    builder = Builder()
    sizes = np.array([[1, 1, 1], [0, 0, 0], [1, 1, 1]], np.float32)
    builder.node(mesh=builder.mesh(), **instancing(builder, SCALE=sizes))
    scene = load_scene(builder.save(tmp_path / "hidden.glb"))
    assert len(scene.meshes[0].triangles) == 4
    assert scene.warnings == ("hidden.glb: instances of size 0: 1 left out",)
