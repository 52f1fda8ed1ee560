"""`bokehguide export --to mitsuba`: XML, PLY and EXR files, without Mitsuba."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
import trimesh

from bokehguide.cli import main
from bokehguide.errors import BokehguideError
from bokehguide.export import export_mitsuba
from bokehguide.export.mitsuba_materials import lost_terms, mitsuba_bsdf
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.shapes import spheres
from bokehguide.scene.types import Aperture, Camera, Cone, Environment, FilmSettings, Material, Mesh, Scene, Sun, Texture

CAMERA = Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), aperture_radius=0.1, focus_distance=4.0)
IMAGE = np.linspace(0.0, 1.0, 24, dtype=np.float32).reshape(2, 3, 4)


def one(material: Material, mesh: Mesh | None = None, **values: object) -> Scene:
    """A ball of a material."""
    ball = mesh or spheres(np.zeros((1, 3)), np.ones(1), 0, 1)
    return Scene("one", CAMERA, (ball,), (material,), FilmSettings(16, 9), **values)


def exported(scene: Scene, folder) -> ET.Element:
    export_mitsuba(scene, folder)
    return ET.parse(folder / "scene.xml").getroot()


def test_a_mesh_comes_back(tmp_path):
    scene = one(Material("m"))
    root = exported(scene, tmp_path)
    assert root.find("shape/ref").attrib == {"name": "bsdf", "id": root.find("bsdf").attrib["id"]}
    mesh = trimesh.load(tmp_path / root.find("shape/string").attrib["value"], process=False)
    np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), scene.meshes[0].vertices)
    np.testing.assert_array_equal(mesh.faces, scene.meshes[0].triangles)
    np.testing.assert_allclose(mesh.vertex_normals, scene.meshes[0].normals, atol=1e-6)


def test_images_come_back(tmp_path):
    texture = Texture(IMAGE, wrap=("mirror", "mirror"), transform=(2.0, 0.0, 0.25, 0.0, 3.0, 0.5))
    root = exported(one(Material("m", (0.5, 1.0, 1.0), specular=0.0, base_color_texture=texture)), tmp_path)
    bitmap = root.find(".//texture")
    values = {child.attrib["name"]: child.attrib.get("value") for child in bitmap}
    assert values["wrap_mode"] == "mirror" and values["raw"] == "true"
    assert bitmap.find("transform/matrix").attrib["value"].split()[:4] == ["2.0", "0.0", "0.0", "0.25"]
    with OpenEXR.File(str(tmp_path / values["filename"])) as file:
        np.testing.assert_allclose(file.channels()["RGB"].pixels, IMAGE[..., :3] * (0.5, 1.0, 1.0), rtol=1e-6)


@pytest.mark.parametrize(
    ("material", "plugin"),
    [
        (Material("m", specular=0.0), "diffuse"),
        (Material("m", metallic=1.0), "principled"),
        (Material("m", clearcoat=0.5), "principled"),
        (Material("m", transmission=1.0, roughness=0.0), "dielectric"),
        (Material("m", transmission=1.0, roughness=0.5), "roughdielectric"),
        (Material("m", transmission=1.0, thin=True), "thindielectric"),
        (Material("m", alpha_mode="blend", opacity=0.5), "mask"),
        (Material("m", normal_texture=Texture(IMAGE)), "normalmap"),
    ],
)
def test_kinds_of_materials(tmp_path, material, plugin):
    root = exported(one(material), tmp_path)
    assert plugin in {bsdf.attrib["type"] for bsdf in root.iter("bsdf")}


def test_emitters_and_lights(tmp_path):
    lamp = Material("lamp", emission=(1.0, 2.0, 3.0), double_sided=True)
    sun = Sun((0.0, 1.0, 0.0), 0.5, (3.0, 2.0, 1.0))
    root = exported(one(lamp, suns=(sun,), environment=Environment(np.ones((4, 8, 3), np.float32))), tmp_path)
    assert [shape.find("emitter/rgb").attrib["value"] for shape in root.iter("shape")] == ["1.0 2.0 3.0"] * 2
    assert {emitter.attrib["type"] for emitter in root.iter("emitter")} == {"area", "envmap", "directional"}
    assert root.find("emitter[@type='directional']/vector").attrib["value"] == "-0.0 -1.0 -0.0"


def test_losses_are_told(tmp_path):
    cone = Cone((0.0, -1.0, 0.0), 10.0, 20.0)
    material = Material("spot", specular_color=(1.0, 0.5, 0.5), emission=(1.0, 1.0, 1.0), emission_cone=cone)
    ball = spheres(np.zeros((1, 3)), np.ones(1), 0, 1)
    scene = one(
        material, replace(ball, colors=np.ones((len(ball.vertices), 4), np.float32)), suns=(Sun((0, 1, 0), 0.5, (1, 1, 1)),)
    )
    scene = replace(scene, camera=replace(CAMERA, aperture=Aperture(blades=6)))
    assert export_mitsuba(scene, tmp_path) == [
        "specular colour: left out (spot)",
        "emission cone: left out (spot)",
        "vertex colours: left out (spot)",
        "shape of the aperture: Mitsuba's lens is round",
        "discs of suns: Mitsuba has lights without a size in their place",
    ]
    assert export_mitsuba(one(Material("plain")), tmp_path) == []


def test_the_command(tmp_path, capsys):
    assert (
        main(["export", "daylight", "--to", "mitsuba", "--out", str(tmp_path / "d"), "--size", "32x18", "--f-number", "2"]) == 0
    )
    told = capsys.readouterr()
    assert f"wrote {tmp_path / 'd' / 'scene.xml'}" in told.out and "created the folder" in told.err
    root = ET.parse(tmp_path / "d" / "scene.xml").getroot()
    assert root.find("sensor/film/integer[@name='width']").attrib["value"] == "32"
    radius = load_scene("daylight", Overrides(f_number=2.0)).camera.aperture_radius
    assert float(root.find("sensor/float[@name='aperture_radius']").attrib["value"]) == pytest.approx(radius)


def test_mistakes(tmp_path, capsys):
    assert main(["export", "daylight", "--to", "pbrt", "--out", str(tmp_path)]) == 2
    assert "--to" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    with pytest.raises(BokehguideError, match="file"):
        export_mitsuba(one(Material("m")), tmp_path / "file")


def test_the_multiple_scattering_of_rough_metals_is_told():
    lost = ["multiple scattering of rough metals"]
    for roughness, single, expected in ((0.6, False, lost), (0.6, True, []), (0.2, False, [])):
        assert lost_terms(Material("m", metallic=1.0, roughness=roughness, single_scattering=single)) == expected


@pytest.mark.parametrize("terms", [{"specular": 0.0}, {"specular_color": (0.0, 0.0, 0.0)}])
def test_a_surface_without_a_coat_is_diffuse(terms):
    bsdf = mitsuba_bsdf(Material("matte", (0.5, 0.4, 0.3), **terms))
    assert bsdf["bsdf"]["type"] == "diffuse" and not lost_terms(Material("matte", **terms))
