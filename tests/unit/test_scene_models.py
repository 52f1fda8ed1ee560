"""Models: other formats than glTF, framing, models in scene files, and real files."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, load_scene, summarize
from tests.support.gltf_square import write_gltf
from tests.support.paths import ASSETS

needs_assets = pytest.mark.skipif(not ASSETS.is_dir(), reason="no shared assets here")


@pytest.mark.slow
def test_obj_materials(tmp_path):
    Image.new("RGB", (1, 1), (188, 188, 188)).save(tmp_path / "wood.png")
    (tmp_path / "m.mtl").write_text("newmtl emitter\nKd 0.001 0 0\nKe 5 4 3\nnewmtl wood\nKd 0.5 0.5 0.5\nmap_Kd wood.png\n")
    (tmp_path / "m.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"
        "usemtl emitter\nf 1 3 4\nusemtl wood\nf 1/1 2/2 3/3\n"
    )
    scene = load_scene(str(tmp_path / "m.obj"))
    materials = {material.name: material for material in scene.materials}
    assert materials["emitter"].emission == (5.0, 4.0, 3.0)
    assert materials["emitter"].base_color == (0.001, 0.0, 0.0)
    np.testing.assert_allclose(materials["wood"].base_color_texture.image, 0.5029, atol=1e-4)
    assert scene.environment is None
    assert scene.warnings == ()
    with (tmp_path / "m.mtl").open("a") as file:
        file.write("Ns 20\nillum 2\n")
    told = "m.obj: .mtl file: illum, ns: have no effect, only Kd, map_Kd and Ke do"
    assert load_scene(str(tmp_path / "m.obj")).warnings == (told,)


@pytest.mark.parametrize("term", ["Kd -0.5 0 0", "Kd nan 0 0", "Ke 1e39 0 0", "Ke inf 0 0"])
def test_obj_materials_out_of_range(tmp_path, term):
    (tmp_path / "m.mtl").write_text(f"newmtl emitter\nKd 0.1 0 0\n{term}\n")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nusemtl emitter\nf 1 2 3\n")
    with pytest.raises(BokehguideError, match=r"m\.obj: material emitter\.k[de]: \[.*out of range"):
        load_scene(str(tmp_path / "m.obj"))


@pytest.mark.parametrize("index", ["1e300", "nan", "9"])
def test_numbers_beyond_integers_are_refused_in_silence(tmp_path, index, recwarn):
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(f"{header}0 0 0\n1 0 0\n0 1 0\n3 0 1 {index}\n")
    with pytest.raises(BokehguideError, match=r"a\.ply"):
        load_scene(str(tmp_path / "a.ply"))
    assert not list(recwarn), "warnings of NumPy"


@pytest.mark.parametrize(
    ("face", "vertex"), [("1 2 9", "9"), ("1/1 2/1 4/1 # a comment", "4"), ("-1 -2 -4", "-4"), ("1 2 x", "x")]
)
def test_a_face_beyond_the_vertices_is_named_by_its_line(tmp_path, face, vertex):
    (tmp_path / "a.obj").write_text(f"# a model\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n\nf 1 2 3\nf {face}\n")
    with pytest.raises(
        BokehguideError, match=rf"/a\.obj:8: the face has the vertex {vertex}, and the file has 3 vertices; repair"
    ):
        load_scene(str(tmp_path / "a.obj"))


@pytest.mark.parametrize(
    ("face", "told"),
    [
        ("0 1 2", "the vertex 0, and the file has 3 vertices"),
        ("1/1 2/2 3/9", "the texture coordinate 9, and the file has 2 texture coordinates"),
        ("1/0 2/2 3/1", "the texture coordinate 0, and the file has 2 texture coordinates"),
        ("1/-3 2/2 3/1", "the texture coordinate -3, and the file has 2 texture coordinates"),
        ("1/1/1 2/1/1 3/1/2", "the normal 2, and the file has 1 normal"),
        ("1//1 2//1 3//0", "the normal 0, and the file has 1 normal"),
    ],
)
def test_a_face_with_an_index_that_the_file_lacks_is_named_by_its_line(tmp_path, face, told):
    good = "f 1 2 3\nf 1/1 2/2 3/1\nf 1//1 2//1 3//-1\nf 1/1/1 -2/-2/-1 3/2/1\n"
    header = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 1\nvn 0 0 1\n"
    (tmp_path / "a.obj").write_text(f"# a model\n{header}{good}")
    assert sum(len(mesh.triangles) for mesh in load_scene(str(tmp_path / "a.obj")).meshes) == 4
    (tmp_path / "a.obj").write_text(f"# a model\n{header}{good}f {face}\n")
    with pytest.raises(BokehguideError, match=rf"/a\.obj:12: the face has {told}; repair the face$"):
        load_scene(str(tmp_path / "a.obj"))


def test_faces_may_have_indices_of_statements_that_the_whole_file_lacks(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1/1 2/2/2 3/3/3\n")
    (mesh,) = load_scene(str(tmp_path / "a.obj")).meshes
    assert len(mesh.triangles) == 1 and mesh.uvs is None


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "glb"])
def test_a_model_is_framed_and_lit(tmp_path, suffix):
    box = trimesh.creation.box((3.0, 1.0, 2.0))
    box.apply_translation((10.0, 20.0, 30.0))
    path = tmp_path / f"box.{suffix}"
    box.export(path)
    scene = load_scene(str(path))
    assert sum(len(mesh.triangles) for mesh in scene.meshes) == 12
    camera = scene.camera
    assert camera.fov == 40.0
    forward = np.subtract(camera.target, camera.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    relative = box.vertices - camera.position
    depth = relative @ forward
    across = np.abs(relative @ right / depth) / np.tan(np.radians(20.0))
    upwards = np.abs(relative @ np.cross(right, forward) / depth) / np.tan(np.radians(20.0)) * 640 / 360
    assert 0.7 < max(across.max(), upwards.max()) < 1.0, "it fills the frame and stays inside"
    assert depth.min() < camera.focus_distance < depth.max(), "focused on the model"
    frame = 2.0 * np.tan(np.radians(20.0)) * camera.focus_distance
    assert 2.0 * camera.aperture_radius == pytest.approx(0.06 * frame), "a disc at infinity has 6 % of the frame's width"
    sky = scene.environment.radiance
    assert sky.shape == (32, 64, 3) and (np.diff(sky[:, 0, 1]) <= 0.0).all() and sky.min() > 0.0


def test_a_wide_ground_does_not_make_a_model_tiny(tmp_path):
    def camera(*boxes):
        """Of a file with boxes, each by its extents."""
        trimesh.Scene([trimesh.creation.box(extents) for extents in boxes]).export(tmp_path / "boxes.glb")
        return load_scene(str(tmp_path / "boxes.glb")).camera.position

    alone, ground, landscape = (1.0, 1.0, 1.0), (40.0, 0.0, 40.0), (400.0, 15.0, 400.0)
    assert camera(ground, alone, landscape) == pytest.approx(camera(alone))
    for wide in ((4.0, 0.0, 4.0), (0.0, 4.0, 4.0), (3.8, 0.18, 3.8)):
        assert camera(alone, wide) == pytest.approx(camera(alone))
    for part_of_it in ((3.4, 0.0, 3.4), (4.0, 0.25, 4.0)):  # 2.8 diagonals, and too thick
        assert np.linalg.norm(camera(alone, part_of_it)) > 1.5 * np.linalg.norm(camera(alone))
    assert np.linalg.norm(camera(ground)) > 40.0, "a ground alone is the model"


def test_the_lens_focuses_on_the_model_and_not_on_its_ground(tmp_path):
    """Two posts, between which the middle of the frame shows the ground behind them."""
    posts, ground = [trimesh.creation.box((0.3, 1.0, 0.3)) for _ in range(2)], trimesh.creation.box((60.0, 0.0, 60.0))
    for post, x in zip(posts, (-1.0, 1.0)):
        post.apply_translation((x, 0.5, 0.0))
    trimesh.Scene([*posts, ground]).export(tmp_path / "post.glb")
    for overrides in (Overrides(), Overrides(camera_target=(0.0, 0.3, 0.0)), Overrides(camera_position=(0.0, 1.0, 4.0))):
        camera = load_scene(str(tmp_path / "post.glb"), overrides).camera
        forward = np.subtract(camera.target, camera.position) / np.linalg.norm(np.subtract(camera.target, camera.position))
        depths = (np.concatenate([post.vertices for post in posts]) - camera.position) @ forward
        assert depths.min() - 0.05 < camera.focus_distance < depths.max() + 0.05


def test_a_model_before_the_sky_is_exposed_for_the_model(tmp_path):
    """An upright white surface becomes diffuse white; a meter would take the sky for it. Own light and rooms are metered."""
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(radius=1.0).export(path)
    scene = load_scene(str(path))
    sky = scene.environment.radiance[:, 0, 1]
    elevation = np.radians(90.0 - (np.arange(len(sky)) + 0.5) * 180.0 / len(sky))
    # Irradiance of a wall by a sky of rotational symmetry: 2 ∫ L cos² d elevation, as the cosine of the azimuth integrates to 2.
    radiance = float((2.0 * sky * np.cos(elevation) ** 2).sum() * np.pi / len(sky)) / np.pi
    assert radiance * 2.0**scene.film.exposure == pytest.approx(1.0, abs=0.15)
    for overrides in (Overrides(camera_target=(0.1, 0.0, 0.0)), Overrides(camera_position=(0.0, 0.0, 1.1))):
        assert load_scene(str(path), overrides).film.exposure == scene.film.exposure
    for overrides in (Overrides(environment="1,1,1"), Overrides(camera_position=(0.0, 0.0, 0.5))):
        assert load_scene(str(path), overrides).film.exposure is None


def test_overrides_of_a_models_camera(tmp_path):
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(radius=1.0).export(path)
    overrides = Overrides(camera_position=(0.0, 0.0, 5.0), camera_target=(0.0, 0.0, 0.0), f_number=2.0, environment="0,0,1")
    scene = load_scene(str(path), overrides)
    assert scene.camera.focus_distance == pytest.approx(4.0), "focused on the nearest part"
    assert scene.camera.aperture_radius == pytest.approx(0.018 / np.tan(np.radians(20.0)) / 4.0)
    np.testing.assert_array_equal(scene.environment.radiance, [[[0.0, 0.0, 1.0]]])
    far = load_scene(str(path), Overrides(fov=10.0)).camera
    assert np.linalg.norm(far.position) > 2.0 * np.linalg.norm(load_scene(str(path)).camera.position)


def test_a_model_in_a_scene_file_keeps_its_materials(tmp_path):
    write_gltf(tmp_path / "square.gltf", {"name": "own", "pbrMetallicRoughness": {"roughnessFactor": 0.3}})
    (tmp_path / "scene.toml").write_text("""
        camera = { position = [0, 0, 5], target = [0, 0, 0] }
        [materials.red]
        base_color = [1, 0, 0]
        [[object]]
        file = "square.gltf"
        [[object]]
        file = "square.gltf"
        material = "red"
        translate = [0, 0, -1]
    """)
    scene = load_scene(str(tmp_path / "scene.toml"))
    assert [scene.materials[mesh.material].name for mesh in scene.meshes] == ["own", "red"]
    assert [material.name for material in scene.materials] == ["red", "own"], "loaded once"
    assert scene.meshes[1].vertices[0, 2] == -1.0


@needs_assets
def test_depth_of_field_example():
    """Emissive strength and the sun, which trimesh loses."""
    scene = load_scene(
        str(ASSETS / "models" / "DepthOfFieldExample.glb"),
        Overrides(environment=str(ASSETS / "hdr" / "st_peters_square_night_1k.hdr")),
    )
    materials = {material.name: material for material in scene.materials}
    assert materials["Lava"].emission == (20.0, 20.0, 20.0)
    assert materials["Lava"].emission_texture is not None
    assert materials["CircuitBoard"].metallic == pytest.approx(0.8912387)
    assert sum(len(mesh.triangles) for mesh in scene.meshes) == 10610
    assert all(mesh.normals is not None for mesh in scene.meshes)
    assert scene.environment.radiance.shape == (512, 1024, 3)
    assert scene.environment.radiance.max() == 10752.0
    (sun,) = scene.suns
    assert sun.irradiance == pytest.approx((10.0,) * 3) and sun.direction[1] > 0.5, "6830 lux from above"
    assert scene.warnings == ()
    said = summarize(scene)
    assert "in 4 emitters; " in said and "environment map of 1024 × 512" in said and "sun" in said


@needs_assets
@pytest.mark.parametrize(
    ("name", "triangles", "meshes"),
    [
        ("FlightHelmet/FlightHelmet.gltf", 94722, 6),
        ("CesiumMilkTruck.glb", 3624, 5),
        ("Duck.glb", 4212, 1),
        ("conformance/02_shared_mesh/02_shared_mesh.gltf", 24, 2),
        ("TransmissionRoughnessTest.glb", 77792, 9),
    ],
)
def test_real_models(name, triangles, meshes):
    scene = load_scene(str(ASSETS / "models" / name))
    assert sum(len(mesh.triangles) for mesh in scene.meshes) == triangles
    assert len(scene.meshes) == meshes
    assert scene.environment is not None
