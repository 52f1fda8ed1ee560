"""Skinned meshes of USD against the sum of the weighted transforms of their joints."""

import numpy as np
import pytest

pytest.importorskip("pxr")

from pxr import Gf, Sdf, UsdSkel, Vt

from bokehguide.scene import Overrides
from tests.support.usd_stages import add_mesh, loaded, new_stage

WEIGHTS = [(1.0, 0.0), (1.0, 0.0), (0.25, 0.75), (0.0, 1.0)]


def skinned():
    """A square between two joints, of which the second one rises by 8 in a second."""
    stage = new_stage()
    stage.SetTimeCodesPerSecond(10)
    UsdSkel.Root.Define(stage, "/rig")
    skeleton = UsdSkel.Skeleton.Define(stage, "/rig/bones")
    names = Vt.TokenArray(["a", "a/b"])
    skeleton.CreateJointsAttr(names)
    rest = Vt.Matrix4dArray([Gf.Matrix4d(1), Gf.Matrix4d(1)])
    skeleton.CreateBindTransformsAttr(rest)
    skeleton.CreateRestTransformsAttr(rest)
    animation = UsdSkel.Animation.Define(stage, "/rig/bones/move")
    animation.CreateJointsAttr(names)
    animation.CreateRotationsAttr([Gf.Quatf(1)] * 2)
    animation.CreateScalesAttr([Gf.Vec3h(1)] * 2)
    moves = animation.CreateTranslationsAttr()
    for code in (0, 10):
        moves.Set([Gf.Vec3f(0), Gf.Vec3f(0, 0, 0.8 * code)], code)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = add_mesh(stage, "/rig/mesh")
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * 4)
    binding.CreateJointWeightsPrimvar(False, 2).Set([weight for pair in WEIGHTS for weight in pair])
    return stage


@pytest.mark.parametrize("seconds", [0.0, 0.5, 1.0])
def test_the_weighted_sum_of_the_joints(seconds, tmp_path):
    mesh = loaded(skinned(), tmp_path, Overrides(time=seconds)).meshes[0]
    order = [int(np.argmin(np.linalg.norm(mesh.vertices[:, :2] - xy, axis=1))) for xy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    np.testing.assert_allclose(mesh.vertices[order, 2], [8.0 * seconds * second for _, second in WEIGHTS], atol=1e-5)


def test_without_a_time_the_start_of_the_stage(tmp_path):
    stage = skinned()
    stage.SetStartTimeCode(10)
    stage.SetEndTimeCode(20)
    assert loaded(stage, tmp_path).meshes[0].vertices[:, 2].max() == pytest.approx(8.0)


def test_the_file_is_not_changed(tmp_path):
    scene = loaded(skinned(), tmp_path, Overrides(time=1.0))
    assert scene.meshes[0].vertices[:, 2].max() == pytest.approx(8.0)
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "scene.usda"))
    assert not layer.dirty and layer.GetAttributeAtPath("/rig/mesh.points").default[2][2] == 0
