"""glTF skins: vertices go where the joints are, and nowhere else."""

import numpy as np
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene
from bokehguide.scene.summary import summarize
from tests.support.gltf_builder import SQUARE, Builder
from tests.support.gltf_skin import TURNED, skinned


def mesh_of(builder: Builder, folder):
    (mesh,) = load_scene(builder.save(folder / "skin.glb")).meshes
    return mesh


def test_the_node_of_a_skinned_mesh_does_not_move_it(tmp_path):
    scene = load_scene(skinned().save(tmp_path / "skin.glb"))
    np.testing.assert_allclose(scene.meshes[0].vertices, SQUARE)
    assert scene.warnings == () and "skins: 1, at rest" in summarize(scene)


def test_vertices_follow_their_joints(tmp_path):
    """The second joint stands in the space of the first."""
    mesh = mesh_of(skinned(first={"translation": [0, 0, 2]}, second={"translation": [1, 0, 3]}), tmp_path)
    np.testing.assert_allclose(mesh.vertices, SQUARE + [[0, 0, 2], [1, 0, 5], [1, 0, 5], [0, 0, 2]])


def test_weights_blend_and_are_made_to_add_up(tmp_path):
    halves = np.array([[0.25, 0.25, 0, 0]] * 4, np.float32)
    mesh = mesh_of(skinned(halves, second={"translation": [4, 0, 0]}), tmp_path)
    np.testing.assert_allclose(mesh.vertices, SQUARE + [2, 0, 0], rtol=1e-6)


def test_in_the_bind_pose_nothing_moves(tmp_path):
    """Inverse bind matrices undo the joints, and normals follow them where the two differ."""
    there = np.eye(4)
    there[:3, 3] = (-1.0, -2.0, -3.0)
    mesh = mesh_of(skinned(bind=[there, there], first={"translation": [1, 2, 3]}), tmp_path)
    np.testing.assert_allclose(mesh.vertices, SQUARE, atol=1e-6)
    mesh = mesh_of(skinned(bind=[there, there], first={"translation": [1, 2, 3], "rotation": TURNED}), tmp_path)
    # (1, -1, 0) is (0, -3, -3) in the joint's space, turns to (-3, -3, 0), and moves back.
    np.testing.assert_allclose(mesh.normals, [[1, 0, 0]] * 4, atol=1e-6)
    np.testing.assert_allclose(mesh.vertices[1], (-2.0, -1.0, 3.0), atol=1e-5)


def test_normals_under_uneven_scale_and_mirrors(tmp_path):
    tilted = np.array([[0.6, 0.0, 0.8]] * 4, np.float32)
    builder = skinned(first={"scale": [2, 1, 1]})
    builder.gltf.meshes[0].primitives[0].attributes.NORMAL = builder.accessor(tilted)
    mesh = mesh_of(builder, tmp_path)
    np.testing.assert_allclose(mesh.normals, [np.array((0.3, 0.0, 0.8)) / np.hypot(0.3, 0.8)] * 4, atol=1e-6)
    mesh = mesh_of(skinned(first={"scale": [1, 1, -1]}), tmp_path)
    a, b, c = mesh.vertices[mesh.triangles[0]]
    assert np.cross(b - a, c - a)[2] < 0.0 and (mesh.normals[:, 2] == -1.0).all()


def test_unsupported_features_of_skins_cause_warnings(tmp_path):
    """Without joints for its vertices, and as one of many instances."""
    builder = skinned(extensions={"EXT_mesh_gpu_instancing": {"attributes": {}}})
    builder.gltf.meshes[0].primitives[0].attributes.JOINTS_0 = None
    scene = load_scene(builder.save(tmp_path / "skin.glb"))
    np.testing.assert_allclose(scene.meshes[0].vertices, SQUARE)
    assert scene.warnings == (
        "skin.glb: skinned meshes without joints and weights: drawn without the transform of their node (meshes[0])",
        "skin.glb: EXT_mesh_gpu_instancing of skinned meshes: one instance is drawn (nodes[0])",
    )


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"joints": np.array([[0, 7, 0, 0]] * 4, np.uint8)}, "joint 7 is not below 2, the number of joints"),
        ({"weights": np.zeros((4, 4), np.float32)}, "weights that add up to 0"),
        ({"bind": [np.eye(4)]}, r"skins\[0\].inverseBindMatrices: .* has 1 matrices for 2 joints"),
        ({"skin": 3}, "skin: 3 is no index into skins, which has 1"),
    ],
)
def test_damaged_skins(tmp_path, changes, named):
    path = skinned(**changes).save(tmp_path / "skin.glb")
    with pytest.raises(BokehguideError, match=named):
        load_scene(path)


def test_joints_outside_the_scene(tmp_path):
    builder = skinned()
    builder.gltf.scenes[0].nodes.pop()
    with pytest.raises(BokehguideError, match=r"skins\[0\].joints: .* is not a list of nodes of the scene"):
        load_scene(builder.save(tmp_path / "skin.glb"))
