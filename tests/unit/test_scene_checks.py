"""The dataclasses of a scene check themselves: class, field, value and remedy in one line, and kind conversions."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from bokehguide.errors import BokehguideError
from bokehguide.scene import Aperture, Camera, Cone, Environment, FilmSettings, Material, Mesh, Scene, Sun, Texture
from bokehguide.scene.shapes import unit_box, unit_rectangle
from bokehguide.train import RenderSettings
from tests.support.scene_text import BOX_AND_EMITTER, load

CAMERA = Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0))
SQUARE = unit_rectangle()
GREY = Material("grey")
SCENE = Scene("square", CAMERA, (SQUARE,), (GREY,))
IMAGE = np.ones((2, 3, 3), np.float32)


@pytest.mark.parametrize(
    ("right", "changes", "named"),
    [
        (CAMERA, {"focus_distance": -1}, "Camera.focus_distance: -1 is out of range; give metres above 0"),
        (CAMERA, {"focus_distance": "far"}, "Camera.focus_distance: 'far' is not a number; give metres above 0"),
        (CAMERA, {"target": (0.0, 0.0, 5.0)}, "Camera.target: (0.0, 0.0, 5.0) equals position"),
        (CAMERA, {"up": (0.0, 0.0, 2.0)}, "Camera.up: (0.0, 0.0, 2.0) makes the camera look along up"),
        (CAMERA, {"up": (0.0, 0.0, 0.0)}, "Camera.up: (0.0, 0.0, 0.0) has no direction"),
        (CAMERA, {"fov": 200}, "Camera.fov: 200 is out of range; give degrees between 0 and 180"),
        (CAMERA, {"fov": True}, "Camera.fov: True is not a number"),
        (CAMERA, {"aperture_radius": -0.1}, "Camera.aperture_radius: -0.1 is out of range"),
        (CAMERA, {"position": (0.0, 1.0)}, "Camera.position: (0.0, 1.0) is not three numbers"),
        (CAMERA, {"position": (0.0, math.nan, 0.0)}, "Camera.position: (0.0, nan, 0.0) is out of range"),
        (CAMERA, {"aperture": 6}, "Camera.aperture: 6 is no Aperture; give Aperture(…) or None"),
        (Aperture(), {"blades": 2}, "Aperture.blades: 2 is out of range; give a whole number from 3 to 64, or 0"),
        (Aperture(), {"curvature": 1.5}, "Aperture.curvature: 1.5 is out of range; give a number between 0 and 1"),
        (Aperture(), {"image": np.zeros((2, 2))}, "Aperture.image: an array of shape (2, 2) is black all over"),
        (Aperture(), {"image": IMAGE}, "Aperture.image: has shape (2, 3, 3), not (H, W)"),
        (FilmSettings(), {"width": 64.5}, "FilmSettings.width: 64.5 is out of range; give a whole number"),
        (FilmSettings(), {"width": 65536, "height": 65536}, "FilmSettings: 65536x65536 pixels are too many"),
        (GREY, {"base_color": (255, 0, 0)}, "Material.base_color: (255, 0, 0) is out of range; give three values, each a number"),
        (GREY, {"emission": (-1.0, 0.0, 0.0)}, "Material.emission: (-1.0, 0.0, 0.0) is out of range"),
        (GREY, {"emission": 5.0}, "Material.emission: 5.0 is not three numbers"),
        (GREY, {"roughness": 2}, "Material.roughness: 2 is out of range; give a number between 0 and 1"),
        (GREY, {"alpha_mode": "blond"}, "Material.alpha_mode: 'blond' is unknown; did you mean 'blend'?"),
        (GREY, {"thin": 1}, "Material.thin: 1 is neither true nor false"),
        (GREY, {"name": None}, "Material.name: None is not a text"),
        (GREY, {"normal_texture": IMAGE}, "Material.normal_texture: an array of shape (2, 3, 3) is no Texture"),
        (GREY, {"emission_cone": 30.0}, "Material.emission_cone: 30.0 is no Cone"),
        (Cone((0, 1, 0), 10.0, 20.0), {"inner": 30.0}, "Cone.outer: 20.0 is not above inner, 30"),
        (Texture(IMAGE), {"image": IMAGE[0]}, "Texture.image: has shape (3, 3), not (H, W, C)"),
        (Texture(IMAGE), {"image": IMAGE[:0]}, "Texture.image: has shape (0, 3, 3), not (H, W, C)"),
        (Texture(IMAGE), {"wrap": "repeat"}, "Texture.wrap: 'repeat' is out of range; give two of repeat, clamp, mirror"),
        (Texture(IMAGE), {"uv_set": -1}, "Texture.uv_set: -1 is out of range"),
        (Texture(IMAGE), {"transform": (1, 0, 0)}, "Texture.transform: (1, 0, 0) is not 6 numbers"),
        (SQUARE, {"uvs": np.zeros((4, 2))}, "Mesh.uvs: has shape (4, 2), not (4, sets, 2)"),
        (SQUARE, {"vertices": np.zeros((4, 2))}, "Mesh.vertices: has shape (4, 2), not (N, 3)"),
        (SQUARE, {"vertices": [[0, 0, 0], [1, 0]]}, "Mesh.vertices: [[0, 0, 0], [1, 0]] is no array of numbers"),
        (SQUARE, {"vertices": SQUARE.vertices * np.float64(1e300)}, "Mesh.vertices[0] is [-1e+300, -1e+300, 0.0], not finite"),
        (SQUARE, {"vertices": SQUARE.vertices * 1e10}, "Mesh.vertices: reach 2e+10 m from end to end"),
        (SQUARE, {"triangles": [[0.0, 1.0, 2.0]]}, "Mesh.triangles: [[0.0, 1.0, 2.0]] is no array of whole numbers"),
        (SQUARE, {"triangles": [[0, 1, 2**32 + 2]]}, "Mesh.triangles[0] has the indices [0, 1, 2147483647], but there are 4"),
        (SQUARE, {"triangles": [[0, 1, -(2**40)]]}, "Mesh.triangles[0] has the indices [0, 1, -1], but there are 4"),
        (SQUARE, {"material": -1}, "Mesh.material: -1 is out of range"),
        (SQUARE, {"material": 0.5}, "Mesh.material: 0.5 is out of range"),
        (Sun((0, 1, 0), 0.5, (1, 1, 1)), {"direction": (0, 0, 0)}, "Sun.direction: (0, 0, 0) has no direction"),
        (Sun((0, 1, 0), 0.5, (1, 1, 1)), {"angle": 100}, "Sun.angle: 100 is out of range; give degrees from 0.01 to 90"),
        (Environment(IMAGE), {"radiance": -IMAGE}, "Environment.radiance[0] is [[-1.0, -1.0, -1.0]"),
        (Environment(IMAGE), {"radiance": 1.0}, "Environment.radiance: has shape (), not (H, W, 3)"),
        (SCENE, {"environment": (1.0, 1.0, 1.0)}, "Scene.environment: (1.0, 1.0, 1.0) is no Environment; give Environment(…)"),
        (SCENE, {"meshes": SQUARE}, "is no list of Mesh"),
        (SCENE, {"materials": [GREY, "red"]}, "Scene.materials[1]: 'red' is no Material"),
        (SCENE, {"meshes": [replace(SQUARE, material=3)]}, "Scene.meshes[0].material: 3 is out of range; there is one material"),
        (SCENE, {"camera": None}, "Scene.camera: None is no Camera; give Camera(…)"),
        (RenderSettings(), {"spp": 2.5}, "spp: 2.5 is out of range; give a whole number of samples per pixel from 1 to"),
        (RenderSettings(), {"spp": 2**40}, "spp: 1099511627776 is out of range; give a whole number of samples per pixel from"),
        (RenderSettings(), {"threads": 1025}, "threads: 1025 is out of range; give a whole number of threads from 1 to 1024"),
        (RenderSettings(), {"seed": 2**32}, "seed: 4294967296 is out of range; give a whole number from -2147483648 to 42949"),
        (RenderSettings(), {"crop": (1.5, 2, 3, 4)}, "crop: (1.5, 2.0, 3.0, 4.0) is in pixels and not whole; give whole pixels"),
        (RenderSettings(), {"crop": (0.5, 0, 0.75, 1)}, "crop: (0.5, 0.0, 0.75, 1.0) leaves the frame; give X,Y,W,H as"),
        (RenderSettings(), {"device": torch.device("meta")}, "device: 'meta' is unknown; choose cpu or cuda"),
        (RenderSettings(), {"device": torch.device("cuda:7")}, "device: 'cuda:7' is unknown; choose cpu or cuda"),
        (RenderSettings(), {"spp": None}, "spp: None is out of range"),
        (RenderSettings(), {"denoise": 1}, "denoise: 1 is neither true nor false"),
        (FilmSettings(), {"exposure": "bright"}, "FilmSettings.exposure: 'bright' is not a number"),
        (RenderSettings(), {"spp": True}, "spp: True is out of range"),
        (RenderSettings(), {"threads": 0}, "threads: 0 is out of range"),
        (RenderSettings(), {"target_noise": "low"}, "target_noise: 'low' is not a number"),
        (RenderSettings(), {"crop": (0, 0, 4)}, "crop: (0, 0, 4) is not 4 numbers"),
    ],
    ids=lambda value: None if isinstance(value, str) else ", ".join(value) if isinstance(value, dict) else type(value).__name__,
)
def test_a_wrong_field_is_named(right, changes, named):
    with pytest.raises(BokehguideError) as caught:
        replace(right, **changes)
    assert named in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_lists_and_arrays_of_other_types_are_converted():
    camera = Camera(np.array([0, 0, 5]), [0, 0, 0], fov=np.float32(30.0), aperture_radius=np.int64(1))
    assert camera == Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), fov=30.0, aperture_radius=1.0)
    assert all(type(number) is float for number in (*camera.position, camera.fov, camera.aperture_radius))
    assert replace(camera, position=tuple(np.float32((0, 0, 5)))) == camera
    mesh = Mesh(
        vertices=SQUARE.vertices.astype(np.float64)[::-1],
        triangles=[[0, 1, 2]],
        material=np.int64(0),
        uvs=np.zeros((4, 1, 2), np.float16),
    )
    assert (mesh.vertices.dtype, mesh.triangles.dtype, mesh.uvs.dtype) == (np.float32, np.int32, np.float32)
    assert mesh.vertices.flags.c_contiguous and type(mesh.material) is int
    assert Environment([0.5, 0.5, 1.0]).radiance.shape == (1, 1, 3)
    assert Scene("list", CAMERA, [mesh], [GREY]).meshes == (mesh,)
    assert Sun((0.0, 2.0, 0.0), 1, (1, 1, 1)).direction == (0.0, 1.0, 0.0)


def test_arrays_of_the_right_type_are_not_copied():
    mesh = replace(SQUARE, material=2)
    assert mesh.vertices is SQUARE.vertices and mesh.triangles is SQUARE.triangles
    assert Texture(IMAGE).image is IMAGE


def test_errors_within_a_scene_file_name_the_file_and_the_object(tmp_path):
    with pytest.raises(BokehguideError, match=r"scene\.toml: object\[0\]: Mesh\.vertices: reach 4e\+17 m"):
        load(tmp_path, BOX_AND_EMITTER.replace("translate = [-0.6, -0.3, 0.5]", "scale = 4e17"))


def test_a_mesh_from_trimesh():
    box = trimesh.creation.box()
    mesh = Mesh.from_trimesh(box, material=1)
    np.testing.assert_array_equal(mesh.vertices, np.asarray(box.vertices, np.float32))
    np.testing.assert_array_equal(mesh.triangles, box.faces)
    assert mesh.material == 1 and mesh.normals is None and mesh.uvs is None
    smooth = Mesh.from_trimesh(trimesh.creation.icosphere(), smooth=True)
    assert smooth.normals is not None
    np.testing.assert_allclose(smooth.normals, smooth.vertices, atol=0.02)
    with pytest.raises(BokehguideError, match=r"Mesh\.from_trimesh: Scene is no Trimesh; give one, or"):
        Mesh.from_trimesh(trimesh.Scene([box]))


def test_texture_coordinates_from_trimesh_point_downwards():
    square = unit_rectangle()
    upwards = square.uvs[:, 0] * (1, -1) + (0, 1)
    visual = trimesh.visual.TextureVisuals(uv=upwards)
    mesh = Mesh.from_trimesh(trimesh.Trimesh(square.vertices, square.triangles, visual=visual, process=False))
    np.testing.assert_allclose(mesh.uvs, square.uvs)


def test_built_in_shapes_pass():
    assert len(unit_box().triangles) == 12


@pytest.mark.parametrize(
    ("crop", "box"),
    [
        ((0.0, 0.0, 1.0, 1.0), (0, 0, 32, 18)),
        ((0.25, 0.25, 0.5, 0.5), (8, 4, 16, 10)),
        (np.array([0.0, 0.5, 1.0, 0.5]), (0, 9, 32, 9)),
        ((0, 0, 1, 1), (0, 0, 1, 1)),
        ((4.0, 2, 3.0, 5), (4, 2, 3, 5)),
    ],
)
def test_a_crop_of_floats_up_to_1_is_in_fractions(crop, box):
    """Whole numbers are pixels, so that a box of one pixel in the corner has a name as well."""
    settings = RenderSettings(crop=crop)
    assert settings.window(32, 18) == box == replace(settings, spp=3).window(32, 18)


def test_devices_of_torch_are_taken():
    assert RenderSettings(device=torch.device("cpu")).device == RenderSettings(device=torch.device("cpu:0")).device == "cpu"
    assert RenderSettings(device=torch.device("cuda")).device == "cuda"


def test_scenes_are_compared_by_identity_and_apertures_by_value():
    textured = Material("textured", base_color_texture=Texture(IMAGE))
    scene = replace(SCENE, materials=(textured,), environment=Environment(IMAGE))
    for one in (scene, scene.meshes[0], scene.environment, textured.base_color_texture):
        other = deepcopy(one)
        assert one == one and one != other and one != replace(one) and len({one, other, one}) == 2
    assert textured != deepcopy(textured) and textured == replace(textured)
    masked = Aperture(image=np.ones((2, 3), np.float32))
    camera = replace(CAMERA, aperture_radius=0.1, aperture=masked)
    assert camera == deepcopy(camera) and hash(camera) == hash(deepcopy(camera))
    for other in (np.ones((3, 2)), np.full((2, 3), 0.5), None):
        assert masked != replace(masked, image=other)
    assert masked != "aperture" and Aperture(blades=5) == Aperture(5) != Aperture(6)
