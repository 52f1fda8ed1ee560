"""USD files that are refused: damaged ones, wrong values, paths outside the folder, and too many instances."""

import os

import pytest

pytest.importorskip("pxr")

from pxr import Sdf, Usd, UsdGeom

from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, load_scene
from tests.support.usd_stages import add_mesh, loaded, new_stage, saved, scattered


def refused(text: str, folder, name: str = "scene.usda") -> str:
    (folder / name).write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(BokehguideError) as caught:
        load_scene(str(folder / name))
    assert len(str(caught.value).splitlines()) <= 2 and name in str(caught.value)
    return str(caught.value)


def test_damaged_files_are_refused(tmp_path, capfd):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    data = (tmp_path / saved(stage, tmp_path, "whole.usdc")).read_bytes()
    assert "not a readable USD file" in refused(data[: len(data) // 2], tmp_path, "half.usdc")
    assert "not a readable USD file" in refused("#usda 1.0\ndef Mesh (((", tmp_path)
    assert "not a readable USD file" in refused("junk", tmp_path, "junk.usd")
    assert "not a readable USD file" in refused("PK junk", tmp_path, "junk.usdz")
    with pytest.raises(BokehguideError, match="no such file"):
        load_scene(str(tmp_path / "gone.usda"))
    assert "holds no triangles" in refused("#usda 1.0\n", tmp_path)
    assert "brackets within brackets" in refused("#usda 1.0\n" + 'def "a" {\n' * 20_000, tmp_path)
    assert capfd.readouterr() == ("", ""), "USD prints nothing"


def meshed(points="(0,0,0),(1,0,0),(1,1,0)", counts="3", indices="0,1,2", extra="") -> str:
    return (
        f'#usda 1.0\ndef Mesh "mesh" {{\npoint3f[] points = [{points}]\nint[] faceVertexCounts = [{counts}]\n'
        f"int[] faceVertexIndices = [{indices}]\n{extra}\n}}\n"
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (meshed(points="(nan,0,0),(1,0,0),(1,1,0)"), "/mesh: points are not finite"),
        (meshed(indices="0,1,3"), "/mesh: faceVertexIndices lead out of the 3 points"),
        (meshed(indices="0,1,-1"), "/mesh: faceVertexIndices lead out"),
        (meshed(indices="0,1"), "/mesh: faceVertexCounts need 3 faceVertexIndices, but there are 2"),
        (meshed(points="(0,0,0),(1e30,0,0),(1,1,0)"), "/mesh: Mesh.vertices"),
        (meshed(extra='def Sphere "ball" { double radius = -1\n}'), "/mesh/ball: radius: -1 is out of range"),
        (meshed(extra='def Sphere "ball" { string radius = "large"\n}'), "/mesh/ball: cannot be read"),
        (meshed().replace("int[] faceVertexCounts = [3]", 'string faceVertexCounts = "3"'), "/mesh: cannot be read"),
        (meshed(extra='uniform token[] xformOpOrder = ["x"]'), "/mesh: cannot be read"),
        ('#usda 1.0\n( metersPerUnit = 0 )\ndef Mesh "m" {\n}\n', "metersPerUnit: 0 is out of range"),
    ],
)
def test_wrong_values_are_refused(text, problem, tmp_path):
    assert problem in refused(text, tmp_path)


@pytest.mark.parametrize("arc", ["references = @../out.usda@", "payload = @../out.usda@", "references = [@/etc/none.usda@]"])
def test_layers_outside_the_folder_are_refused(arc, tmp_path):
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "out.usda").write_text(meshed())
    assert "lies outside the scene's folder" in refused(f'#usda 1.0\ndef "a" ( {arc} ) {{\n}}\n', folder)
    assert "lies outside" in refused("#usda 1.0\n( subLayers = [@../out.usda@] )\n", folder)
    clips = '#usda 1.0\ndef "a" ( clips = { dictionary default = { asset[] assetPaths = [@../out.usda@]\n} } ) {\n}\n'
    assert "lies outside" in refused(clips, folder)


def test_layers_of_the_folder_are_read_and_missing_ones_are_told(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "part.usda").write_text(meshed().replace("#usda 1.0", '#usda 1.0\n( defaultPrim = "mesh" )'))
    (tmp_path / "scene.usda").write_text('#usda 1.0\ndef "a" ( references = [@parts/part.usda@, @./gone.usda@] ) {\n}\n')
    scene = load_scene(str(tmp_path / "scene.usda"))
    assert len(scene.meshes) == 1
    assert any("gone.usda" in line for line in scene.warnings)


def test_cycles_are_told(tmp_path):
    text = meshed().replace('def Mesh "mesh"', 'def Mesh "mesh" ( references = @./scene.usda@</mesh> )')
    (tmp_path / "scene.usda").write_text(text)
    scene = load_scene(str(tmp_path / "scene.usda"))
    assert len(scene.meshes) == 1 and any("Cycle" in line for line in scene.warnings)


def test_exponential_instances_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("bokehguide.scene.files.FREE_MESHES", 1000)
    layer = Sdf.Layer.CreateAnonymous(".usda")
    stage = Usd.Stage.Open(layer)
    add_mesh(stage, "/level0/mesh")
    for level in range(1, 9):
        for number in range(10):
            prim = UsdGeom.Xform.Define(stage, f"/level{level}/copy{number}").GetPrim()
            prim.GetReferences().AddInternalReference(f"/level{level - 1}")
            prim.SetInstanceable(True)
    with pytest.raises(BokehguideError, match=r"makes more than|makes [\d,]+ (triangles|meshes) in all"):
        loaded(stage, tmp_path)


def test_points_within_points_are_bounded(tmp_path):
    stage = new_stage()
    instancer = scattered(stage)
    instancer.CreatePrototypesRel().SetTargets(["/many", "/many/a"])
    with pytest.raises(BokehguideError, match="point instancers within each other"):
        loaded(stage, tmp_path)
    instancer.CreateProtoIndicesAttr([0, 5, 0, 1])
    with pytest.raises(BokehguideError, match="/many: protoIndices lead out of the 2 prototypes"):
        loaded(stage, tmp_path)


def test_variants_of_stages_without_any_are_refused(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    with pytest.raises(BokehguideError, match=r"scene.usda: 'red' is no variant of this stage; give SET=NAME; it has none"):
        loaded(stage, tmp_path, Overrides(variant="red"))


def test_a_reader_that_dies_is_a_message(tmp_path, monkeypatch):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    path = saved(stage, tmp_path, "scene.usdc")
    monkeypatch.setattr("bokehguide.scene.usd.isolation.PROGRAM", "import os; os.abort()")
    with pytest.raises(BokehguideError, match=r"scene.usdc: the USD libraries fail on this file"):
        load_scene(path)


def test_the_reader_of_binary_files_imports_nothing_from_the_working_folder(tmp_path, monkeypatch):
    """A downloaded folder may hold a module with the name of one that Python brings."""
    stage = new_stage()
    add_mesh(stage, "/mesh")
    path = saved(stage, tmp_path, "scene.usdc")
    (tmp_path / "pickle.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    assert len(load_scene(path).meshes) == 1


@pytest.mark.parametrize("place", [16, -16, -48])
def test_huge_sizes_in_binary_files_are_refused(place, tmp_path):
    """The place of the table of contents, in the header, and the places of sections, in the table at the end."""
    stage = new_stage()
    add_mesh(stage, "/mesh")
    path = saved(stage, tmp_path, "scene.usdc")
    data = bytearray((tmp_path / "scene.usdc").read_bytes())
    start = place % len(data)
    data[start : start + 8] = (2**50).to_bytes(8, "little")
    (tmp_path / "scene.usdc").write_bytes(data)
    with pytest.raises(BokehguideError, match=r"scene\.usdc: (not a readable USD file|the USD libraries fail)"):
        load_scene(path)


def test_a_folder_whose_name_is_no_text(tmp_path, monkeypatch):
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    monkeypatch.chdir(folder)
    (folder / "scene.usda").write_text(meshed())
    with pytest.raises(
        BokehguideError, match=r"^scene\.usda: '.*udce9/scene\.usda' is no UTF-8 text; rename the file or folder$"
    ):
        load_scene("scene.usda")
