"""USD stages as scenes: units, axes, transforms, instances, cameras and time."""

import math
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("pxr")

from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdRender

from bokehguide.cli import main
from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.model_files import load_model
from tests.support.usd_stages import add_mesh, corners, facing, loaded, new_stage, saved, scattered


def box_of(scene) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([mesh.vertices for mesh in scene.meshes])
    return points.min(axis=0), points.max(axis=0)


def nested(stage) -> None:
    """Two objects under rotated and scaled parents."""
    parent = UsdGeom.Xform.Define(stage, "/world")
    parent.AddTranslateOp().Set(Gf.Vec3d(3, -2, 5))
    parent.AddRotateXYZOp().Set(Gf.Vec3f(20, -70, 35))
    child = UsdGeom.Xform.Define(stage, "/world/arm")
    child.AddScaleOp().Set(Gf.Vec3f(2, 0.5, -3))
    add_mesh(stage, "/world/arm/square").AddRotateZOp().Set(30.0)
    add_mesh(stage, "/world/other").AddTranslateOp().Set(Gf.Vec3d(0, 4, 1))


@pytest.mark.parametrize("unit", [1.0, 0.01, 0.0254])
@pytest.mark.parametrize("up", ["Y", "Z"])
def test_the_box_of_the_meshes_is_that_of_usd(unit, up, tmp_path):
    stage = new_stage(unit, up)
    nested(stage)
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"], useExtentsHint=False)
    wanted = np.array(
        [[*cache.ComputeWorldBound(stage.GetPrimAtPath("/world")).ComputeAlignedRange().GetCorner(n)] for n in range(8)]
    )
    wanted = wanted @ (np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if up == "Z" else np.eye(3)) * unit
    low, high = box_of(loaded(stage, tmp_path))
    # The box of USD is that of the boxes of the parts in their own space, which is not the smallest one.
    assert (low >= wanted.min(axis=0) - 1e-5).all() and (high <= wanted.max(axis=0) + 1e-5).all()
    every = [UsdGeom.Imageable(stage.GetPrimAtPath(path)) for path in ("/world/arm/square", "/world/other")]
    matrices = [np.array(each.ComputeLocalToWorldTransform(Usd.TimeCode.Default())) for each in every]
    points = np.concatenate([np.array([(-1, -1, 0, 1), (1, -1, 0, 1), (1, 1, 0, 1), (-1, 1, 0, 1)]) @ m for m in matrices])[:, :3]
    points = points @ (np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if up == "Z" else np.eye(3)) * unit
    np.testing.assert_allclose([low, high], [points.min(axis=0), points.max(axis=0)], atol=1e-5 * unit)


def test_a_mirrored_mesh_keeps_its_front(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mirrored").AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    add_mesh(stage, "/left").CreateOrientationAttr("leftHanded")
    scene = loaded(stage, tmp_path)
    assert facing(scene, 0).sum(axis=0) == pytest.approx([0, 0, 4])
    assert facing(scene, 1).sum(axis=0) == pytest.approx([0, 0, -4])


def test_names_lead_to_objects(tmp_path):
    stage = new_stage()
    nested(stage)
    mesh = loaded(stage, tmp_path).meshes[0]
    assert (mesh.name, mesh.groups) == ("square", ("arm", "world"))


def test_invisible_prims_and_guides_are_not_drawn(tmp_path):
    stage = new_stage()
    for name in ("shown", "render", "guide", "proxy", "hidden", "inactive"):
        add_mesh(stage, f"/{name}/mesh")
    for name in ("render", "guide", "proxy"):
        UsdGeom.Imageable(UsdGeom.Xform.Define(stage, f"/{name}")).CreatePurposeAttr(name)
    UsdGeom.Xform.Define(stage, "/hidden").CreateVisibilityAttr("invisible")
    stage.GetPrimAtPath("/inactive").SetActive(False)
    stage.CreateClassPrim("/abstract")
    add_mesh(stage, "/abstract/mesh")
    drawn = [mesh.groups[0] for mesh in loaded(stage, tmp_path).meshes]
    assert drawn == ["shown", "render"]


def test_instances_of_the_scene_graph(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/part/mesh")
    for number in range(3):
        prim = UsdGeom.Xform.Define(stage, f"/copy{number}")
        prim.AddTranslateOp().Set(Gf.Vec3d(number, 0, 0))
        prim.GetPrim().GetReferences().AddInternalReference("/part")
        prim.GetPrim().SetInstanceable(True)
    scene = loaded(stage, tmp_path)
    middles = sorted(corners(scene, number).reshape(-1, 3).mean(axis=0)[0] for number in range(4))
    assert len(scene.meshes) == 4 and middles == pytest.approx([0, 0, 1, 2], abs=0.4)


def test_instances_of_points(tmp_path):
    stage = new_stage()
    scattered(stage)
    first, second = loaded(stage, tmp_path).meshes
    np.testing.assert_allclose(first.vertices.min(axis=0), (-0.5, -0.5, 7), atol=1e-6)
    np.testing.assert_allclose(first.vertices.max(axis=0), (0.5, 0.5, 7), atol=1e-6)
    np.testing.assert_allclose(second.vertices.min(axis=0), (8, -2, 6), atol=5e-3)
    np.testing.assert_allclose(second.vertices.max(axis=0), (30, 2, 8), atol=5e-3)
    assert len(first.triangles) == 2 and len(second.triangles) == 4


def test_the_camera_is_that_of_usd(tmp_path):
    stage = new_stage(0.01, "Z")
    add_mesh(stage, "/mesh")
    camera = UsdGeom.Camera.Define(stage, "/rig/main")
    camera.AddTranslateOp().Set(Gf.Vec3d(100, -300, 50))
    camera.AddRotateXYZOp().Set(Gf.Vec3f(80, 10, 30))
    for set_, value in (
        (camera.CreateFocalLengthAttr, 35.0),
        (camera.CreateHorizontalApertureAttr, 32.0),
        (camera.CreateVerticalApertureAttr, 18.0),
        (camera.CreateFStopAttr, 2.8),
        (camera.CreateFocusDistanceAttr, 250.0),
    ):
        set_(value)
    truth = camera.GetCamera(Usd.TimeCode.Default())
    found = loaded(stage, tmp_path).camera
    assert found.fov == pytest.approx(truth.GetFieldOfView(Gf.Camera.FOVHorizontal), abs=1e-4)
    assert found.aperture_radius == pytest.approx(0.035 / 2.8 / 2, rel=1e-6)
    assert found.f_number == pytest.approx(2.8, rel=1e-5)
    assert found.focus_distance == pytest.approx(2.5)
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    position = turn @ np.array(truth.frustum.GetPosition()) * 0.01
    forward = turn @ np.array(truth.frustum.ComputeViewDirection())
    np.testing.assert_allclose(found.position, position, atol=1e-6)
    direction = np.subtract(found.target, found.position)
    np.testing.assert_allclose(direction / np.linalg.norm(direction), forward, atol=1e-6)
    np.testing.assert_allclose(found.up, turn @ np.array(truth.frustum.ComputeUpVector()), atol=1e-6)


@pytest.mark.parametrize(("size", "kept"), [((320, 100), "vertical"), ((200, 200), "horizontal")])
def test_the_whole_frame_of_the_camera_is_seen(size, kept, tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    camera = UsdGeom.Camera.Define(stage, "/main")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    camera.CreateFStopAttr(4.0)
    truth = camera.GetCamera(Usd.TimeCode.Default())
    found = loaded(stage, tmp_path, Overrides(width=size[0], height=size[1])).camera
    wanted = truth.GetFieldOfView(Gf.Camera.FOVHorizontal if kept == "horizontal" else Gf.Camera.FOVVertical)
    across = math.tan(math.radians(found.fov) / 2)
    seen = across if kept == "horizontal" else across * size[1] / size[0]
    assert math.degrees(2 * math.atan(seen)) == pytest.approx(wanted, abs=1e-4)
    assert found.f_number == pytest.approx(4.0, rel=1e-5)


def test_a_camera_without_an_f_stop_gets_a_lens_and_one_of_zero_none(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    camera = UsdGeom.Camera.Define(stage, "/main")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    found = loaded(stage, tmp_path).camera
    assert found.aperture_radius > 0 and found.focus_distance == pytest.approx(5.0)
    camera.CreateFStopAttr(0.0)
    assert loaded(stage, tmp_path).camera.aperture_radius == 0
    camera.CreateFStopAttr(2.0)
    assert loaded(stage, tmp_path).camera.focus_distance == pytest.approx(5.0), "of the middle of the frame"


def test_options_keep_the_sensor_and_the_f_number_of_the_stage(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/square")
    camera = UsdGeom.Camera.Define(stage, "/main")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    camera.CreateFocalLengthAttr(0.5)
    camera.CreateHorizontalApertureAttr(0.2)
    camera.CreateVerticalApertureAttr(0.15)
    camera.CreateFStopAttr(2.8)
    size = {"width": 400, "height": 300}
    found = loaded(stage, tmp_path, Overrides(**size)).camera
    assert (found.sensor_width, found.f_number) == (pytest.approx(20.0), pytest.approx(2.8))
    wide = loaded(stage, tmp_path, Overrides(fov=60.0, **size)).camera
    assert (wide.sensor_width, wide.f_number) == (pytest.approx(20.0), pytest.approx(2.8))
    assert wide.aperture_radius == pytest.approx(0.01 / math.tan(math.radians(30.0)) / 5.6)
    for view in ({"camera": "frame"}, {"camera_position": (0.0, 0.0, 3.0)}, {"camera_target": (0.1, 0.0, 0.0)}):
        framed = loaded(stage, tmp_path, Overrides(fov=60.0, f_number=1.4, **view, **size)).camera
        assert framed.sensor_width == pytest.approx(20.0)
        assert framed.aperture_radius == pytest.approx(0.01 / math.tan(math.radians(30.0)) / 2.8)


def test_cameras_with_negative_numbers_are_told_or_refused(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    camera = UsdGeom.Camera.Define(stage, "/main")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    camera.CreateFStopAttr(-1.0)
    scene = loaded(stage, tmp_path)
    assert scene.camera.aperture_radius == 0 and "f-stops below 0: a pinhole" in "\n".join(scene.warnings)
    camera.CreateFocalLengthAttr(-35.0)
    with pytest.raises(BokehguideError, match="/main: focalLength: -35 is out of range; give a number above 0"):
        loaded(stage, tmp_path)


def test_cameras_by_name_and_by_the_render_settings(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    for number, name in enumerate(("left", "right")):
        UsdGeom.Camera.Define(stage, f"/{name}").AddTranslateOp().Set(Gf.Vec3d(number, 0, 5))
    settings = UsdRender.Settings.Define(stage, "/Render/main")
    settings.CreateResolutionAttr(Gf.Vec2i(333, 111))
    settings.CreateCameraRel().SetTargets(["/right"])
    assert loaded(stage, tmp_path).camera.position[0] == 0
    stage.SetMetadata("renderSettingsPrimPath", "/Render/main")
    scene = loaded(stage, tmp_path)
    assert (scene.camera.position[0], scene.film.width, scene.film.height) == (1, 333, 111)
    assert any("cameras: 0 right, 1 left" in line for line in scene.supported)
    assert loaded(stage, tmp_path, Overrides(camera="left")).camera.position[0] == 0
    with pytest.raises(BokehguideError, match=r"no camera of .*; it has 0 \(right\), 1 \(left\)"):
        loaded(stage, tmp_path, Overrides(camera="top"))


def test_a_stage_of_a_mesh_alone_is_framed_under_a_sky(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    scene = loaded(stage, tmp_path)
    assert scene.environment is not None and scene.camera.aperture_radius > 0


def test_time_moves_the_animation(tmp_path):
    stage = new_stage()
    stage.SetTimeCodesPerSecond(10)
    move = add_mesh(stage, "/mesh").AddTranslateOp()
    move.Set(Gf.Vec3d(1, 0, 0), 5)
    move.Set(Gf.Vec3d(11, 0, 0), 15)

    def place(seconds=None) -> float:
        return float(corners(loaded(stage, tmp_path, Overrides(time=seconds)))[..., 0].mean())

    middles = [place(), place(0.5), place(1.0), place(9.0)]
    assert np.subtract(middles, middles[0]) == pytest.approx([0, 0, 5, 10], abs=1e-5)
    stage.SetStartTimeCode(15)
    stage.SetEndTimeCode(20)
    assert place() == pytest.approx(middles[3]), "the start of the stage"


@pytest.mark.parametrize("name", ["scene.usda", "scene.usdc", "scene.usd"])
def test_the_render_of_a_file(name, tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    path = saved(stage, tmp_path, name)
    assert main(["render", path, "--spp", "1", "--size", "16x9", "--out", str(tmp_path / "a.exr")]) == 0
    assert (tmp_path / "a.png").exists()


def test_without_the_libraries(tmp_path, monkeypatch, capsys):
    path = saved(new_stage(), tmp_path)
    monkeypatch.setitem(sys.modules, "pxr", None)
    assert main(["render", path]) == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 2 and "pip install 'bokehguide[usd]'" in error[1] and path in error[0]


def test_a_stage_is_an_object_of_a_scene_file(tmp_path):
    stage = new_stage(0.01)
    add_mesh(stage, "/mesh")
    UsdLux.DomeLight.Define(stage, "/dome")
    UsdLux.SphereLight.Define(stage, "/bulb").AddTranslateOp().Set(Gf.Vec3d(0, 0, 100))
    saved(stage, tmp_path, "part.usda")
    text = '[camera]\nposition = [0, 0, 4]\ntarget = [0, 0, 0]\n[[object]]\nfile = "part.usda"\ntranslate = [0, 0, -1]\n'
    (tmp_path / "scene.toml").write_text(text)
    scene = load_scene(str(tmp_path / "scene.toml"))
    assert scene.meshes[0].vertices[:, 2] == pytest.approx(-1.0) and scene.environment is None
    assert scene.meshes[1].vertices.mean(axis=0) == pytest.approx((0, 0, 0), abs=1e-3)
    assert scene.materials[scene.meshes[1].material].emits
    assert "dome lights of models: 1 left out, as [environment] lights the scene" in scene.warnings


def test_binary_files_give_the_same_scene_and_count_what_they_hold(tmp_path):
    stage = new_stage()
    nested(stage)
    text, binary = (load_scene(saved(stage, tmp_path, f"scene.{kind}")) for kind in ("usda", "usdc"))
    assert len(text.meshes) == len(binary.meshes) == 2 and text.materials == binary.materials
    for first, second in zip(text.meshes, binary.meshes):
        np.testing.assert_array_equal(first.vertices, second.vertices)
    files = SceneFiles(tmp_path)
    load_model(tmp_path / "scene.usdc", files)
    assert files.used[0] == (tmp_path / "scene.usdc").stat().st_size


def test_the_process_for_binary_files_imports_no_large_library(tmp_path):
    """A process for each file would take seconds to import PyTorch, trimesh or scipy."""
    stage = new_stage()
    add_mesh(stage, "/smooth", scheme="catmullClark")
    for number, shape in enumerate(
        (UsdGeom.Sphere, UsdGeom.Cube, UsdGeom.Cone, UsdGeom.Cylinder, UsdGeom.Capsule, UsdGeom.Plane)
    ):
        shape.Define(stage, f"/shape{number}").AddRotateXYZOp().Set(Gf.Vec3f(20, -70, 35))
    for light in (UsdLux.SphereLight, UsdLux.RectLight, UsdLux.DiskLight, UsdLux.CylinderLight, UsdLux.DistantLight):
        light.Define(stage, f"/{light.__name__}")
    (tmp_path / "sky.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n" + bytes([99, 99, 99, 129] * 2))
    UsdLux.DomeLight.Define(stage, "/sky").CreateTextureFileAttr("./sky.hdr")
    code = f"""if True:
        import pickle, sys
        from pathlib import Path
        from bokehguide.scene.files import SceneFiles
        from bokehguide.scene.model import ModelState
        from bokehguide.scene.usd.loading import read_usd
        path = Path({saved(stage, tmp_path, "scene.usdc")!r})
        model = read_usd(path, SceneFiles(path.parent), ModelState(), binary=True)
        assert len(model.meshes) == 7 and len(model.emitters) == 4 and model.environment.radiance.max() > 0.1
        print(*({{"torch", "trimesh", "scipy"}} & set(sys.modules)))
    """
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (finished.stdout.strip(), finished.stderr) == ("", "")


VARIANTS = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "Shelf" (
    variants = {
        string size = "small"
    }
    prepend variantSets = "size"
)
{
    variantSet "size" = {
        "small" {
            def Sphere "Ball" {
                double radius = 1
            }
        }
        "big" {
            def Sphere "Ball" (
                variants = {
                    string paint = "red"
                }
                prepend variantSets = "paint"
            )
            {
                double radius = 3
                variantSet "paint" = {
                    "red" {
                        color3f[] primvars:displayColor = [(1, 0, 0)]
                    }
                    "sky-blue" {
                        color3f[] primvars:displayColor = [(0, 0, 1)]
                    }
                }
            }
        }
    }
}
def Cube "Box" (
    variants = {
        string paint = "red"
    }
    prepend variantSets = "paint"
)
{
    variantSet "paint" = {
        "red" {
            color3f[] primvars:displayColor = [(1, 0, 0)]
        }
        "green" {
            color3f[] primvars:displayColor = [(0, 1, 0)]
        }
    }
}
"""


def painted(path, variant: str | None) -> tuple[float, set[tuple[float, float, float]]]:
    """The radius of the ball and the colours of a stage with a variant."""
    scene = load_scene(str(path), Overrides(variant=variant))
    (ball,) = (mesh for mesh in scene.meshes if mesh.name == "Ball")
    colors = {tuple(scene.materials[mesh.material].base_color) for mesh in scene.meshes if mesh.name != "Ball"}
    return float(ball.vertices.max()), colors | {tuple(scene.materials[ball.material].base_color)}


@pytest.mark.parametrize("name", ["stage.usda", "stage.usdc"])
def test_variants_of_a_stage_are_chosen(tmp_path, name):
    path = tmp_path / name
    (tmp_path / "stage.usda").write_text(VARIANTS)
    Sdf.Layer.FindOrOpen(str(tmp_path / "stage.usda")).Export(str(path))
    grey, red, green, blue = (0.18,) * 3, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    assert painted(path, None) == (pytest.approx(1.0, rel=0.01), {grey, red})
    assert painted(path, "size=big") == (pytest.approx(3.0, rel=0.01), {red})
    assert painted(path, "paint=green") == (pytest.approx(1.0, rel=0.01), {grey, green})
    assert painted(path, "paint=sky-blue, size=big") == (pytest.approx(3.0, rel=0.01), {red, blue})
    assert painted(path, None) == (pytest.approx(1.0, rel=0.01), {grey, red}), "the choice does not stay"
    lines = load_scene(str(path), Overrides(variant="size=big")).supported
    assert f"{name}: variants: paint=green, paint=red, paint=sky-blue, size=big, size=small; drawn: size=big" in lines


@pytest.mark.parametrize("variant", ["big", "size=huge", "colour=red", "size=", "=", "paint=green,"])
def test_a_variant_that_a_stage_lacks_is_told(tmp_path, variant):
    (tmp_path / "stage.usda").write_text(VARIANTS)
    with pytest.raises(BokehguideError) as caught:
        load_scene(str(tmp_path / "stage.usda"), Overrides(variant=variant))
    told = "is no variant of this stage; give SET=NAME; it has paint=green, paint=red, size=big, size=small"
    assert str(caught.value).endswith(told) and "stage.usda: " in str(caught.value)


def test_objects_of_scene_files_choose_variants_of_a_stage(tmp_path):
    (tmp_path / "stage.usda").write_text(VARIANTS)
    objects = "".join(f'[[object]]\nfile = "stage.usda"\nvariant = "{choice}"\n' for choice in ("size=big", "size=small"))
    (tmp_path / "scene.toml").write_text(f"[camera]\nposition = [0, 0, 9]\ntarget = [0, 0, 0]\n{objects}")
    balls = [mesh.vertices.max() for mesh in load_scene(str(tmp_path / "scene.toml")).meshes if mesh.name == "Ball"]
    assert balls == pytest.approx([3.0, 1.0], rel=0.01)
