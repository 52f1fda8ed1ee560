"""TOML scene files: every field reaches the scene, and objects have the right transform."""

import math

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image

from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.digest import digest
from bokehguide.scene.inspection import objects
from bokehguide.scene.shapes import transform, transformed, unit_box, unit_rectangle, unit_sphere
from tests.support.gltf_square import write_gltf
from tests.support.scene_text import BALL, CAMERA, load


def test_every_field_of_the_format(tmp_path):
    Image.new("RGB", (2, 1), (188, 0, 255)).save(tmp_path / "wood.png")
    scene = load(
        tmp_path,
        """
        [camera]
        position = [0.0, 1.0, 6.0]
        target = [0.0, 0.5, 0.0]
        up = [0.0, 1.0, 0.1]
        fov = 50.0
        aperture_radius = 0.15
        focus_distance = 5.0
        [film]
        width = 320
        height = 200
        max_depth = 4
        [environment]
        color = [0.1, 0.2, 0.3]
        intensity = 2.0
        rotation = 30.0
        [materials.gold]
        base_color = [1.0, 0.77, 0.34]
        metallic = 1.0
        roughness = 0.2
        specular = 0.5
        transmission = 0.25
        thin = true
        ior = 1.4
        emission = [0.0, 1.0, 2.0]
        base_color_texture = "wood.png"
        metallic_roughness_texture = "wood.png"
        emission_texture = "wood.png"
        double_sided = true
        [[object]]
        shape = "box"
        material = "gold"
        """,
    )
    assert scene.name == "scene"
    assert scene.camera.position == (0.0, 1.0, 6.0) and scene.camera.target == (0.0, 0.5, 0.0)
    assert scene.camera.up == (0.0, 1.0, 0.1) and scene.camera.fov == 50.0
    assert scene.camera.aperture_radius == 0.15 and scene.camera.focus_distance == 5.0
    assert (scene.film.width, scene.film.height, scene.film.max_depth) == (320, 200, 4)
    assert scene.environment.radiance.shape == (1, 1, 3) and scene.environment.rotation == 30.0
    np.testing.assert_allclose(scene.environment.radiance[0, 0], (0.2, 0.4, 0.6), rtol=1e-6)
    (gold,) = scene.materials
    assert (gold.name, gold.base_color, gold.emission) == ("gold", (1.0, 0.77, 0.34), (0.0, 1.0, 2.0))
    assert (gold.metallic, gold.roughness, gold.specular, gold.transmission) == (1.0, 0.2, 0.5, 0.25)
    assert gold.thin and gold.ior == 1.4 and gold.double_sided and gold.emits
    # sRGB 188 is 0.503 in linear light; metallic-roughness is not encoded.
    np.testing.assert_allclose(gold.base_color_texture.image[0, 0], (0.5029, 0.0, 1.0), atol=1e-4)
    np.testing.assert_allclose(gold.emission_texture.image[0, 1], (0.5029, 0.0, 1.0), atol=1e-4)
    np.testing.assert_allclose(gold.metallic_roughness_texture.image[0, 0], (188 / 255, 0.0, 1.0), rtol=1e-6)
    assert gold.base_color_texture.image.dtype == np.float32


def test_what_is_left_out_has_its_default(tmp_path):
    scene = load(tmp_path, CAMERA + BALL)
    assert scene.environment is None and scene.camera.fov == 40.0
    assert scene.camera.aperture_radius == 0.0
    assert scene.camera.focus_distance == 6.0, "without a focus the target is in focus"
    assert (scene.film.width, scene.film.height, scene.film.max_depth) == (640, 360, 6)
    assert scene.warnings == ()


def test_a_texture_multiplies_factors_of_one(tmp_path):
    Image.new("RGB", (1, 1), (255, 255, 255)).save(tmp_path / "white.png")
    text = CAMERA + BALL.replace(
        "base_color = [0.5, 0.5, 0.5]",
        'base_color_texture = "white.png"\nmetallic_roughness_texture = "white.png"',
    )
    (material,) = load(tmp_path, text).materials
    assert material.base_color == (1.0, 1.0, 1.0)
    assert (material.metallic, material.roughness) == (1.0, 1.0)


def test_focal_length_and_f_number(tmp_path):
    camera = load(tmp_path, CAMERA + "focal_length = 50.0\nsensor_width = 36.0\nf_number = 1.4\n" + BALL).camera
    assert camera.fov == pytest.approx(2.0 * math.degrees(math.atan(18.0 / 50.0)))
    assert camera.aperture_radius == pytest.approx(0.050 / 2.8)


def test_focus_point_is_measured_along_the_axis(tmp_path):
    camera = load(tmp_path, CAMERA + "focus_point = [3.0, 5.0, 2.0]\n" + BALL).camera
    assert camera.focus_distance == pytest.approx(4.0)


@pytest.mark.parametrize("suffix", ["hdr", "exr"])
def test_environment_maps(tmp_path, suffix):
    rng = np.random.default_rng(1)
    radiance = rng.random((8, 16, 3), dtype=np.float32) * 100.0
    path = tmp_path / f"sky.{suffix}"
    if suffix == "exr":
        OpenEXR.File({}, {"RGB": radiance}).write(str(path))
    else:
        import OpenImageIO as oiio

        image = oiio.ImageBuf(oiio.ImageSpec(16, 8, 3, oiio.FLOAT))
        image.set_pixels(oiio.ROI(), radiance)
        assert image.write(str(path))
    text = CAMERA + BALL + f'[environment]\nmap = "sky.{suffix}"\nintensity = 0.5\nrotation = -90.0\n'
    environment = load(tmp_path, text).environment
    assert environment.rotation == -90.0 and environment.radiance.dtype == np.float32
    # RGBE shares one exponent among three mantissas of 8 bits.
    np.testing.assert_allclose(environment.radiance, radiance / 2.0, atol=0.5 if suffix == "hdr" else 0)


def test_negative_texels_are_clamped_with_a_warning(tmp_path):
    radiance = np.ones((4, 8, 3), np.float32)
    radiance[1, 2] = -0.5
    OpenEXR.File({}, {"RGB": radiance}).write(str(tmp_path / "sky.exr"))
    scene = load(tmp_path, CAMERA + BALL + '[environment]\nmap = "sky.exr"\n')
    assert scene.environment.radiance.min() == 0.0
    assert scene.warnings == ("sky.exr: negative texels, set to 0: 1, the first in column 2 and row 1, counted from 0",)


def test_objects_are_scaled_then_turned_then_moved(tmp_path):
    text = (
        CAMERA
        + """
[materials.grey]
[[object]]
shape = "rectangle"
material = "grey"
scale = [2.0, 0.5, 1.0]
rotate = [0.0, 90.0, 0.0]
translate = [10.0, 20.0, 30.0]
"""
    )
    (mesh,) = load(tmp_path, text).meshes
    # The rectangle's x axis has turned to -z, and its front from +z to +x.
    np.testing.assert_allclose(mesh.vertices.min(axis=0), (10.0, 19.5, 28.0), atol=1e-5)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), (10.0, 20.5, 32.0), atol=1e-5)
    np.testing.assert_allclose(normals_of(mesh), [(1.0, 0.0, 0.0)] * 2, atol=1e-6)


def test_rotation_is_about_x_then_y_then_z():
    matrix = transform(rotate=(90.0, 90.0, 0.0))
    # About x: +y to +z; then about y: +z to +x.
    np.testing.assert_allclose(matrix[:3, :3] @ (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), atol=1e-12)


def normals_of(mesh):
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    normals = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (3.0, 0.5, 1.0), (-1.0, 1.0, 1.0), (-2.0, -1.0, -0.3)])
def test_normals_and_fronts_survive_any_scale(scale):
    mesh = transformed(unit_sphere(), transform((1.0, 2.0, 3.0), (20.0, -35.0, 70.0), scale))
    flat = normals_of(mesh)
    middles = mesh.vertices[mesh.triangles].mean(axis=1) - (1.0, 2.0, 3.0)
    assert (np.einsum("ij,ij->i", flat, middles) > 0.0).all(), "a front turned inwards"
    smooth = mesh.normals[mesh.triangles]
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, rtol=1e-5)
    assert np.einsum("ij,ikj->ik", flat, smooth).min() > 0.5
    # The ellipsoid's exact normal is the gradient of |S⁻¹ Rᵀ (x - t)|².
    linear = transform(rotate=(20.0, -35.0, 70.0), scale=scale)[:3, :3]
    gradient = unit_sphere().normals.astype(np.float64) @ np.linalg.inv(linear)
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.normals, gradient, atol=1e-5)


def test_sphere_is_as_round_as_promised():
    """Projected area within 0.1 %, silhouette within 0.3 %, seen from any direction."""
    from scipy.spatial import ConvexHull

    sphere = unit_sphere()
    points = sphere.vertices.astype(np.float64)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions = np.concatenate([directions, np.eye(3), np.asarray(points[:12])])
    for direction in directions / np.linalg.norm(directions, axis=1, keepdims=True):
        right = np.cross(direction, (0.31, 0.52, 0.79))
        right /= np.linalg.norm(right)
        seen = np.stack([points @ right, points @ np.cross(direction, right)], axis=1)
        hull = ConvexHull(seen)
        assert hull.volume == pytest.approx(np.pi, rel=1e-3)
        assert -hull.equations[:, 2].max() > 1.0 - 3e-3, "the outline dips below the circle"
        assert np.linalg.norm(seen, axis=1).max() < 1.0 + 3e-3
    np.testing.assert_allclose(sphere.normals, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-6)


def test_sphere_texture_has_no_seam():
    sphere = unit_sphere()
    away_from_poles = np.abs(sphere.vertices[sphere.triangles][..., 1]).max(axis=1) < 0.9
    u = sphere.uvs[sphere.triangles[away_from_poles]][..., 0, 0]
    assert np.ptp(u, axis=1).max() < 0.1
    assert sphere.uvs[..., 1].min() >= 0.0 and sphere.uvs[..., 1].max() <= 1.0
    top = sphere.vertices[:, 1].argmax()
    assert sphere.uvs[top, 0, 1] < 0.02, "v grows downwards"


def test_box_faces_outwards_with_unit_sides():
    box = unit_box()
    np.testing.assert_array_equal(np.abs(box.vertices), 0.5)
    middles = box.vertices[box.triangles].mean(axis=1)
    assert len(box.triangles) == 12
    np.testing.assert_allclose(np.einsum("ij,ij->i", normals_of(box), middles), 0.5, atol=1e-6)


def test_rectangle_texture_stands_upright():
    rectangle = unit_rectangle()
    top_left = (rectangle.vertices == (-1.0, 1.0, 0.0)).all(axis=1)
    np.testing.assert_array_equal(rectangle.uvs[top_left], [[(0.0, 0.0)]])


def test_degenerate_triangles_are_dropped(tmp_path):
    (tmp_path / "sliver.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\nf 1 1 2\n")
    text = CAMERA + BALL + '[[object]]\nfile = "sliver.obj"\nmaterial = "grey"\n'
    assert [len(mesh.triangles) for mesh in load(tmp_path, text).meshes] == [1280, 1]


def test_overrides_take_the_place_of_the_files_values(tmp_path):
    text = CAMERA + "focal_length = 50.0\nf_number = 2.0\nfocus_point = [0.0, 1.0, 2.0]\n" + BALL
    camera = load(tmp_path, text, Overrides(f_number=4.0)).camera
    assert camera.aperture_radius == pytest.approx(0.050 / 8.0)
    assert camera.focus_distance == pytest.approx(4.0)
    camera = load(tmp_path, text, Overrides(camera_position=(0.0, 1.0, 8.0))).camera
    assert camera.position == (0.0, 1.0, 8.0)
    assert camera.focus_distance == pytest.approx(6.0), "the focus stays on its point"
    camera = load(tmp_path, text, Overrides(fov=30.0)).camera
    assert camera.fov == pytest.approx(30.0)
    assert camera.aperture_radius == pytest.approx(0.018 / math.tan(math.radians(15.0)) / 4.0)
    camera = load(tmp_path, text, Overrides(aperture_radius=0.25, focus_distance=9.0)).camera
    assert (camera.aperture_radius, camera.focus_distance) == (0.25, 9.0)
    scene = load(tmp_path, text, Overrides(width=64, height=32, environment="1, 2,3.5"))
    assert (scene.film.width, scene.film.height) == (64, 32)
    np.testing.assert_array_equal(scene.environment.radiance, [[[1.0, 2.0, 3.5]]])


def test_another_light_leaves_the_environments_rotation_and_visibility(tmp_path):
    """The intensity belongs to the replaced radiance."""
    text = CAMERA + BALL + "[environment]\ncolor = [1, 1, 1]\nintensity = 4.0\nrotation = 30.0\nvisible = false\n"
    scene = load(tmp_path, text, Overrides(environment="0.5,0.25,0"))
    assert scene.environment.radiance.tolist() == [[[0.5, 0.25, 0.0]]]
    assert (scene.environment.rotation, scene.environment.visible) == (30.0, False)
    plain = load(tmp_path, CAMERA + BALL, Overrides(environment="0.5,0.25,0")).environment
    assert (plain.rotation, plain.visible) == (0.0, True)


def test_f_number_without_focal_length_means_a_36_mm_sensor():
    camera = load_scene("fairy-lights", Overrides(f_number=2.0)).camera
    assert camera.fov == pytest.approx(40.0)
    assert camera.aperture_radius == pytest.approx(0.018 / math.tan(math.radians(20.0)) / 4.0)


def copies(file: str, *names: str) -> str:
    """Two objects of a model side by side."""
    keys = [f'name = "{name}"\n' for name in names] or ["", ""]
    lines = (f'[[object]]\nfile = "{file}"\n{key}translate = [{x}, 0, 0]\n' for key, x in zip(keys, (-1.5, 1.5)))
    return CAMERA + "".join(lines)


def test_the_name_of_an_object_is_that_of_its_model(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    text = copies("box.ply", "left", "right")
    named, plain = load(tmp_path, text), load(tmp_path, copies("box.ply"))
    assert [(entry.name, entry.low[0], entry.high[0]) for entry in objects(named)] == [("left", -2.0, -1.0), ("right", 1.0, 2.0)]
    assert [(entry.name, entry.low[0], entry.high[0]) for entry in objects(plain)] == [("box.ply", -2.0, 2.0)]
    assert digest(named.meshes) == digest(plain.meshes)
    for name in ("right", "box.ply"):
        assert load(tmp_path, text, Overrides(focus_on=name)).camera.focus_distance == pytest.approx(5.5)


def test_the_parts_of_a_named_model_have_both_names(tmp_path):
    nodes = [{"mesh": 0, "name": "lid"}, {"mesh": 0, "name": "pot", "translation": [0, 1, -1]}, {"mesh": 0, "name": "lid"}]
    write_gltf(tmp_path / "pot.gltf", nodes=nodes)
    text = copies("pot.gltf", "left", "right")
    assert [entry.name for entry in objects(load(tmp_path, text))] == ["left/lid", "left/pot", "right/lid", "right/pot"]
    assert [entry.name for entry in objects(load(tmp_path, copies("pot.gltf")))] == ["lid", "pot"]
    for name, distance in {"left": 6.0, "left/pot": 7.0, "pot": 7.0, "right/lid": 6.0}.items():
        assert load(tmp_path, text, Overrides(focus_on=name)).camera.focus_distance == pytest.approx(distance)
