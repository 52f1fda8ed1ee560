"""Models: other formats than glTF, framing, models in scene files, and real files."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, load_scene, summarize
from bokehguide.scene.model_files import load_model
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
        file.write("Ka 1 1 1\nillum 2\n#Tf 1 1 1\nKm 1\nmap_Bump wood.png\n")
    assert load_scene(str(tmp_path / "m.obj")).warnings == (
        "m.obj: .mtl file: map_bump with a height map: left out; give a normal map (wood)",
        "m.obj: .mtl file: km: have no effect",
    )


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


def mtl(folder, statements: str):
    """The material of a triangle with `statements` in its `.mtl` file."""
    (folder / "m.mtl").write_text(f"newmtl a\n{statements}\n")
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"
    (folder / "m.obj").write_text(f"mtllib m.mtl\n{corners}usemtl a\nf 1/1 2/2 3/3\n")
    return load_scene(str(folder / "m.obj"))


@pytest.mark.parametrize(
    ("statements", "wanted"),
    [
        (
            "Kd 0.5 0.5 0.5",
            {"base_color": (0.5, 0.5, 0.5), "roughness": 1.0, "specular": 1.0, "opacity": 1.0, "alpha_mode": "opaque"},
        ),
        ("Ns 250\nKs 0.25 0.25 0.25", {"roughness": 0.5, "specular": 0.5}),
        ("Ns 2000\nKs 0 0 0", {"roughness": 0.0, "specular": 0.0}),
        ("Ns 250\nPr 0.3\nPm 1", {"roughness": 0.3, "metallic": 1.0}),
        ("Ni 1.7", {"ior": 1.7}),
        ("Ni 1", {"ior": 1.5}),
        ("d 0.25", {"opacity": 0.25, "alpha_mode": "blend"}),
        ("d -halo 0.25", {"opacity": 0.25, "alpha_mode": "blend"}),
        ("Tr 0.25", {"opacity": 0.75, "alpha_mode": "blend"}),
        ("Tr 1", {"opacity": 1.0, "alpha_mode": "opaque"}),
        ("d 1\nTr 1", {"opacity": 1.0, "alpha_mode": "opaque"}),
        ("map_d lost.png", {"opacity": 1.0, "alpha_mode": "opaque"}),
    ],
)
def test_gloss_and_opacity_of_obj_materials(tmp_path, statements, wanted):
    found = mtl(tmp_path, statements).materials[0]
    for key, value in wanted.items():
        assert getattr(found, key) == (pytest.approx(value) if key != "alpha_mode" else value)


@pytest.mark.parametrize("mode", ["L", "RGBA"])
def test_opacity_maps_of_obj_materials(tmp_path, mode):
    """The alpha of map_d, or its grey, becomes the alpha of map_Kd."""
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "red.png")
    Image.new(mode, (4, 1), 51 if mode == "L" else (255, 255, 255, 51)).save(tmp_path / "holes.png")
    scene = mtl(tmp_path, "map_Kd red.png\nmap_d holes.png\nd 0.5")
    found = scene.materials[0]
    assert (found.alpha_mode, found.opacity, scene.warnings) == ("blend", 1.0, ())
    np.testing.assert_allclose(found.base_color_texture.image, np.broadcast_to((1.0, 0.0, 0.0, 0.1), (2, 4, 4)), atol=1e-6)


def test_an_opacity_map_outside_the_folder_is_refused(tmp_path):
    (tmp_path / "model").mkdir()
    Image.new("L", (1, 1)).save(tmp_path / "holes.png")
    with pytest.raises(BokehguideError, match=r"'../holes\.png' lies outside the scene's folder"):
        mtl(tmp_path / "model", "map_d ../holes.png")


@pytest.mark.parametrize("options", ["-s 1 1 1 -o 0.5 0 -0.5", "-clamp on -bm 1", "-mm 0 1 -imfchan r -blendu off"])
def test_options_before_a_texture(tmp_path, options):
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "-1 red.png")
    scene = mtl(tmp_path, f"map_Kd {options} -1 red.png\nmap_d {options} -1 red.png")
    assert scene.materials[0].base_color_texture.image.shape == (2, 2, 4) and scene.warnings == ()


@pytest.mark.parametrize("key", ["map_d", "map_Ke", "map_Bump", "norm"])
def test_a_missing_map_is_told(tmp_path, key):
    assert mtl(tmp_path, f"{key} lost.png").warnings == ("m.obj: lost.png: no such file; left out",)


@pytest.mark.parametrize(
    ("factor", "wanted"), [("", (1.0, 1.0, 1.0)), ("Ke 0 0 0\n", (1.0, 1.0, 1.0)), ("Ke 3 2 1\n", (3.0, 2.0, 1.0))]
)
def test_emission_maps_of_obj_materials(tmp_path, factor, wanted):
    """map_Ke is sRGB, and multiplies a Ke above 0."""
    Image.new("RGB", (2, 2), (255, 188, 0)).save(tmp_path / "glow.png")
    scene = mtl(tmp_path, f"{factor}map_Ke glow.png")
    found = scene.materials[0]
    assert found.emission == wanted and found.emits and not any("map_ke" in line for line in scene.warnings)
    np.testing.assert_allclose(found.emission_texture.image[0, 0], (1.0, 0.503, 0.0), atol=1e-3)


@pytest.mark.parametrize(
    ("key", "scale"), [("norm", 1.0), ("map_Bump", 1.0), ("bump", 1.0), ("map_Bump -bm 0.5", 0.5), ("bump -bm x", 1.0)]
)
def test_normal_maps_of_obj_materials(tmp_path, key, scale):
    Image.new("RGB", (2, 2), (128, 100, 250)).save(tmp_path / "normals.png")
    scene = mtl(tmp_path, f"{key} normals.png")
    found = scene.materials[0]
    np.testing.assert_allclose(found.normal_texture.image[0, 0], np.array((128, 100, 250)) / 255.0, atol=1e-6)
    assert found.normal_scale == scale and scene.warnings == ()


def test_height_maps_of_obj_materials_are_told(tmp_path):
    Image.new("L", (2, 2), 128).save(tmp_path / "heights.png")
    scene = mtl(tmp_path, "map_Bump heights.png")
    assert scene.materials[0].normal_texture is None
    assert scene.warnings == ("m.obj: .mtl file: map_bump with a height map: left out; give a normal map (a)",)


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_vertex_colours_are_srgb(tmp_path, suffix):
    points, colors = np.eye(3), [(255, 0, 0, 255), (0, 188, 0, 255), (0, 0, 0, 255)]
    trimesh.Trimesh(points, [(0, 1, 2)], vertex_colors=colors, process=False).export(tmp_path / f"a.{suffix}")
    scene = load_scene(str(tmp_path / f"a.{suffix}"))
    np.testing.assert_allclose(scene.meshes[0].colors, [(1, 0, 0, 1), (0, 0.5029, 0, 1), (0, 0, 0, 1)], atol=1e-3)
    assert scene.materials[0].base_color == (1.0, 1.0, 1.0) and scene.warnings == ()


def test_face_colours_are_srgb(tmp_path):
    points, faces = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]), [(0, 1, 2), (0, 2, 3)]
    colors = [(255, 0, 0, 255), (0, 188, 0, 255)]
    trimesh.Trimesh(points, faces, face_colors=colors, process=False).export(tmp_path / "a.ply")
    (mesh,) = load_scene(str(tmp_path / "a.ply")).meshes
    np.testing.assert_allclose(mesh.vertices[mesh.triangles], points[faces])
    wanted = np.array([(1, 0, 0, 1), (0, 0.5029, 0, 1)])[:, None].repeat(3, axis=1)
    np.testing.assert_allclose(mesh.colors[mesh.triangles], wanted, atol=1e-3)


def test_negative_indices_count_back_from_their_face(tmp_path):
    """Two triangles, each after its own vertices, normals and texture coordinates."""
    corners = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (5.0, 0.0, 0.0), (6.0, 0.0, 0.0), (6.0, 1.0, 0.0)]
    text = ""
    for start in (0, 3):
        text += "".join(f"v {x} {y} {z}\nvt {x} {y}\n" for x, y, z in corners[start : start + 3])
        text += f"vn 0 0 {1 - 2 * (start == 3)}\nf -3/-3/-1 -2/-2/-1 -1/-1/-1 # v -1\n"
    (tmp_path / "a.obj").write_text(text)
    (mesh,) = load_scene(str(tmp_path / "a.obj")).meshes
    np.testing.assert_allclose(mesh.vertices[mesh.triangles].reshape(-1, 3), corners)
    np.testing.assert_allclose(mesh.uvs[mesh.triangles].reshape(-1, 2)[:, 0], [x for x, _, _ in corners])
    np.testing.assert_allclose(mesh.normals[mesh.triangles][:, 0, 2], [1.0, -1.0])


STRIP = "ply\nformat {order} 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
STRIP += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
LADDER = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 2, 0)], np.float32)


def lines(rows: np.ndarray) -> str:
    """Rows of numbers as text."""
    return "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist())


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian"])
def test_triangle_strips_of_ply_files(tmp_path, order):
    """All triangles face +z: every second one of a strip is turned, and -1 begins another strip."""
    strip = np.array([0, 1, 2, 3, -1, 2, 3, 4, -1], np.int32)
    text = (lines(LADDER) + f"9 {' '.join(map(str, strip))}\n").encode()
    body = text if order == "ascii" else LADDER.tobytes() + np.int32(9).tobytes() + strip.tobytes()
    (tmp_path / "a.ply").write_bytes(STRIP.format(order=order).encode() + body)
    (mesh,) = load_scene(str(tmp_path / "a.ply")).meshes
    assert mesh.triangles.tolist() == [[0, 1, 2], [2, 1, 3], [2, 3, 4]] and mesh.name == "a.ply"


def test_a_triangle_strip_beyond_the_vertices_is_refused(tmp_path):
    (tmp_path / "a.ply").write_text(f"{STRIP.format(order='ascii')}{lines(LADDER)}3 0 1 7\n")
    with pytest.raises(BokehguideError, match=r"a\.ply.*\[0, 1, 7\]"):
        load_scene(str(tmp_path / "a.ply"))


def test_a_model_that_hides_the_sky_is_told(tmp_path):
    """A lamp would light the room, and outside the sky does."""
    room = trimesh.creation.box((4, 4, 4))
    room.invert()
    room.export(tmp_path / "room.ply")
    inside = Overrides(camera_position=(0.0, 0.0, 1.0), camera_target=(0.0, 0.0, 0.0))
    (told,) = load_scene(str(tmp_path / "room.ply"), inside).warnings
    assert told.startswith("room.ply: surfaces such as 'room.ply' hide the sky, the only light, from the camera; give the model")
    assert load_scene(str(tmp_path / "room.ply")).warnings == ()
    open_room = room.submesh([np.flatnonzero(room.face_normals[:, 1] > -0.5)], append=True)
    open_room.export(tmp_path / "open.ply")
    assert load_scene(str(tmp_path / "open.ply"), inside).warnings == ()


def test_a_file_that_is_no_model_is_refused(tmp_path):
    (tmp_path / "a.toml").write_text("")
    with pytest.raises(BokehguideError, match=r"a.toml: is no model; give a file with one of the suffixes .glb .gltf .obj"):
        load_model(tmp_path / "a.toml")
