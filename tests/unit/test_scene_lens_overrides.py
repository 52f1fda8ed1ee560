"""Focus on nodes of a model, f-numbers of every kind of lens, and aperture overrides of a Scene with its own aperture."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import Aperture, Overrides, Scene, load_scene
from tests.support.gltf_square import write_gltf

WALL = """
[camera]
position = [0.0, 1.0, 0.0]
target = [0.0, 1.0, -1.0]
CAMERA
[film]
width = 64
height = 64
[environment]
color = [1.0, 1.0, 1.0]
[materials.clay]
[[object]]
name = "floor"
shape = "rectangle"
material = "clay"
rotate = [-90.0, 0.0, 0.0]
scale = 50.0
"""
"""A floor 1 m below the camera."""
WIDE = "fov = 90.0\naperture_radius = 0.1"


def floor(folder, camera=WIDE, **overrides) -> Scene:
    path = folder / "floor.toml"
    path.write_text(WALL.replace("CAMERA", camera))
    return load_scene(str(path), Overrides(**overrides))


def failure(call, *arguments, **keywords) -> str:
    with pytest.raises(BokehguideError) as caught:
        call(*arguments, **keywords)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# The depth on the floor is 32 / (y - 32) at the raster row y of 64, for a field of view of 90 degrees.
@pytest.mark.parametrize(
    ("point", "depth"),
    [((32, 48), 32 / 16.5), ((32.2, 48.9), 32 / 16.5), ((0.5, 0.75), 2.0), ((0, 63), 32 / 31.5), ((1, 1), 1.0)],
    ids=str,
)
def test_pixels_have_a_middle_and_fractions_have_none(tmp_path, point, depth):
    assert floor(tmp_path, focus_at=point).camera.focus_distance == pytest.approx(depth, rel=1e-4)


def test_pixels_count_in_the_final_size(tmp_path):
    larger = floor(tmp_path, focus_at=(64, 96), width=128, height=128)
    assert larger.camera.focus_distance == pytest.approx(64 / 32.5, rel=1e-4)


NODES = [
    {"name": "stand", "children": [1, 2], "translation": [0, 0, -1]},
    {"name": "left leaf", "mesh": 0, "translation": [-2, 0, -1]},
    {"name": "right leaf", "mesh": 0, "translation": [2, 0, -4]},
    {"name": "card", "mesh": 0, "translation": [0, 2.5, -3]},
]
"""Squares of 2 × 2 at the depths 2, 5 and 3 before a camera in the origin."""


@pytest.mark.parametrize(
    ("name", "depth"), [("left leaf", 2.0), ("right leaf", 5.0), ("card", 3.0), ("stand", 2.0), ("bouquet", 2.0)]
)
def test_focus_on_a_node_means_all_below_it(tmp_path, name, depth):
    """The near leaf has most of the visible area of the nodes above it."""
    material = {"name": "paper", "doubleSided": True}
    model = write_gltf(tmp_path / "leaves.gltf", material, nodes=NODES, scenes=[{"nodes": [0, 3]}])
    view = {"camera_position": (0.0, 0.0, 0.0), "camera_target": (0.0, 0.0, -1.0), "fov": 120.0}
    if name != "bouquet":
        assert load_scene(model, Overrides(focus_on=name, **view)).camera.focus_distance == pytest.approx(depth, rel=1e-4)
    text = f"""
        camera = {{ position = [0, 0, 0], target = [0, 0, -1], fov = 120, aperture_radius = 0.1, focus_on = "{name}" }}
        [environment]
        color = [1, 1, 1]
        [[object]]
        name = "bouquet"
        file = "leaves.gltf"
    """
    (tmp_path / "scene.toml").write_text(text)
    assert load_scene(str(tmp_path / "scene.toml")).camera.focus_distance == pytest.approx(depth, rel=1e-4)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ('focus_on = "cley"', "floor.toml: camera.focus_on: 'cley' is no object, node or material"),
        ("focus_on = 3", "floor.toml: camera.focus_on: 3 is not a text"),
        ("focus_at = [80, 3]", "floor.toml: camera.focus_at: 80,3 lies outside the frame of 64x64"),
        ("focus_at = [1, 2]", "floor.toml: camera.focus_at: nothing but background at 1,2"),
        ("focus_at = [1]", "floor.toml: camera.focus_at: [1] is not two numbers"),
        ("focus_at = [-0.1, 0.5]", "floor.toml: camera.focus_at: [-0.1, 0.5] is out of range"),
        (
            "focus_at = [1, 2]\nfocus_distance = 2.0",
            "floor.toml: camera.focus_distance: 2.0 and focus_at = [1, 2] are both",
        ),
    ],
    ids=str,
)
def test_a_key_without_a_target_is_refused_in_one_line(tmp_path, key, message):
    assert message in failure(floor, tmp_path, f"{WIDE}\n{key}")


FROM_FOV = 18.0 / math.tan(math.radians(30.0))
"""Millimetres: focal length with a field of view of 60 degrees across 36 mm."""


@pytest.mark.parametrize(
    ("keys", "millimetres", "fov"),
    [
        ("fov = 60.0", FROM_FOV, 60.0),
        ("fov = 60.0\nsensor_width = 24.0", FROM_FOV * 24.0 / 36.0, 60.0),
        ("focal_length = 50.0", 50.0, 2.0 * math.degrees(math.atan(0.36))),
        ("focal_length = 50.0\nsensor_width = 24.0", 50.0, 2.0 * math.degrees(math.atan(0.24))),
    ],
    ids=str,
)
def test_f_number_is_focal_length_by_diameter_everywhere(tmp_path, keys, millimetres, fov):
    radius = 1e-3 * millimetres / (2.0 * 2.8)
    of_file = floor(tmp_path, f"{keys}\nf_number = 2.8").camera
    of_option = floor(tmp_path, f"{keys}\naperture_radius = 0.5", f_number=2.8).camera
    of_scene = load_scene(floor(tmp_path, f"{keys}\naperture_radius = 0.5"), Overrides(f_number=2.8)).camera
    for camera in (of_file, of_option, of_scene):
        assert camera.fov == pytest.approx(fov)
        assert camera.aperture_radius == pytest.approx(radius)
        assert camera.f_number == pytest.approx(2.8)


OWN = Aperture(blades=6, rotation=10.0, curvature=0.25, ratio=1.5, cat_eye=0.5, edge=0.25)
TABLE = "aperture = { blades = 6, rotation = 10, curvature = 0.25, ratio = 1.5, cat_eye = 0.5, edge = 0.25 }"
FIELDS = {"blades": 5, "rotation": 20.0, "curvature": 0.75, "ratio": 2.0, "cat_eye": 1.0, "edge": -0.5}


def with_own(folder, aperture: Aperture) -> Scene:
    scene = floor(folder)
    return replace(scene, camera=replace(scene.camera, aperture=aperture))


def aperture_of(scene: Scene, **overrides) -> Aperture:
    aperture = load_scene(scene, Overrides(**overrides)).camera.aperture
    assert aperture is not None
    return aperture


@pytest.mark.parametrize("field", FIELDS)
def test_an_option_replaces_one_field_of_the_aperture(tmp_path, field):
    option = {f"aperture_{field}": FIELDS[field]}
    expected = replace(OWN, **{field: FIELDS[field]})
    assert floor(tmp_path, f"{WIDE}\n{TABLE}", **option).camera.aperture == expected
    assert aperture_of(with_own(tmp_path, OWN), **option) == expected, "a Scene with an aperture of its own"


def test_options_make_an_aperture_where_there_is_none(tmp_path):
    options = {f"aperture_{field}": value for field, value in FIELDS.items()}
    assert aperture_of(floor(tmp_path), **options) == Aperture(**FIELDS)


def test_no_blades_make_the_aperture_round(tmp_path):
    expected = Aperture(ratio=1.5, cat_eye=0.5, edge=0.25)
    assert floor(tmp_path, f"{WIDE}\n{TABLE}", aperture_blades=0).camera.aperture == expected
    assert aperture_of(with_own(tmp_path, OWN), aperture_blades=0) == expected


def test_a_mask_replaces_blades_and_blades_replace_a_mask(tmp_path):
    Image.fromarray(np.array([[255, 51], [0, 255]], np.uint8)).save(tmp_path / "mask.png")
    mask = np.array([[1.0, 0.2], [0.0, 1.0]], np.float32)
    masked = aperture_of(with_own(tmp_path, OWN), aperture_image=str(tmp_path / "mask.png"))
    np.testing.assert_allclose(masked.image, mask, atol=1e-6)
    assert replace(masked, image=None) == Aperture(rotation=10.0, ratio=1.5, cat_eye=0.5)
    own = with_own(tmp_path, Aperture(image=mask, rotation=30.0, cat_eye=0.5))
    turned = aperture_of(own, aperture_rotation=45.0)
    np.testing.assert_array_equal(turned.image, mask)
    assert replace(turned, image=None) == Aperture(rotation=45.0, cat_eye=0.5)
    file = f'{WIDE}\naperture = {{ image = "mask.png", rotation = 30, cat_eye = 0.5 }}'
    for aperture in (aperture_of(own, aperture_blades=5), floor(tmp_path, file, aperture_blades=5).camera.aperture):
        assert aperture == Aperture(blades=5, rotation=30.0, cat_eye=0.5)


def test_the_own_aperture_of_a_scene_stays_without_an_option(tmp_path):
    for own in (OWN, Aperture(curvature=0.5, rotation=20.0)):
        assert aperture_of(with_own(tmp_path, own), f_number=2.0, fov=50.0) == own


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"aperture_blades": 2}, "--aperture-blades: 2 is out of range"),
        ({"aperture_ratio": 20.0}, "--aperture-ratio: 20.0 is out of range; give a number between 0.1 and 10"),
        ({"aperture_cat_eye": 2.0}, "--aperture-cat-eye: 2.0 is out of range"),
        ({"aperture_edge": 5.0}, "--aperture-edge: 5.0 is out of range"),
        ({"aperture_blades": 0, "aperture_curvature": 0.5}, "--aperture-curvature: 0.5 has no blades beside it"),
        ({"aperture_image": "none.png"}, "none.png: no such file"),
    ],
    ids=str,
)
def test_a_wrong_option_of_the_aperture_is_named(tmp_path, overrides, message):
    for scene in (floor(tmp_path), with_own(tmp_path, OWN)):
        assert message in failure(aperture_of, scene, **overrides)


def test_an_option_without_effect_is_refused(tmp_path):
    masked = with_own(tmp_path, Aperture(image=np.ones((2, 2), np.float32)))
    assert "edge = 0.5 are both given; keep one" in failure(aperture_of, masked, aperture_edge=0.5)
    round_one = with_own(tmp_path, Aperture(cat_eye=0.5))
    assert "--aperture-curvature: 0.5 has no blades" in failure(aperture_of, round_one, aperture_curvature=0.5)
    assert "--aperture-edge: 0.5 has no effect on a pinhole" in failure(floor, tmp_path, "fov = 60.0", aperture_edge=0.5)
