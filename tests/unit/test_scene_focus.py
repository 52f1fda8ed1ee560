"""Focus at a pixel and on a name, f-numbers, and apertures from the command line."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.scene import Aperture, Overrides, load_scene

TWO_WALLS = """
[camera]
position = [0.0, 0.0, 0.0]
target = [0.0, 0.0, -1.0]
fov = 90.0
{lens}

[film]
width = 64
height = 64

[environment]
color = [1.0, 1.0, 1.0]

[materials.clay]
[materials.slate]

[[object]]
name = "near wall"
shape = "rectangle"
material = "clay"
translate = [-3.0, 0.0, -2.0]
scale = 3.0

[[object]]
name = "far wall"
shape = "rectangle"
material = "slate"
translate = [4.0, 0.0, -4.0]
scale = 4.0
"""


def walls(tmp_path, lens="aperture_radius = 0.1", **overrides):
    """Two walls that face the camera: on the left at depth 2, on the right at depth 4."""
    path = tmp_path / "walls.toml"
    path.write_text(TWO_WALLS.format(lens=lens))
    return load_scene(str(path), Overrides(**overrides))


@pytest.mark.parametrize(("point", "depth"), [((3, 32), 2.0), ((60, 32), 4.0), ((0.1, 0.5), 2.0), ((0.9, 0.9), 4.0)], ids=str)
def test_focus_at_a_point_is_the_depth_along_the_axis(tmp_path, point, depth):
    assert walls(tmp_path, focus_at=point).camera.focus_distance == pytest.approx(depth, rel=1e-5)
    lens = f"aperture_radius = 0.1\nfocus_at = [{point[0]}, {point[1]}]"
    assert walls(tmp_path, lens).camera.focus_distance == pytest.approx(depth, rel=1e-5)


@pytest.mark.parametrize(("name", "depth"), [("near wall", 2.0), ("far wall", 4.0), ("slate", 4.0), ("clay", 2.0)])
def test_focus_on_an_object_or_a_material(tmp_path, name, depth):
    assert walls(tmp_path, focus_on=name).camera.focus_distance == pytest.approx(depth, rel=1e-5)
    assert walls(tmp_path, f'aperture_radius = 0.1\nfocus_on = "{name}"').camera.focus_distance == pytest.approx(depth, rel=1e-5)


def test_an_option_replaces_the_focus_of_the_file(tmp_path):
    lens = 'aperture_radius = 0.1\nfocus_on = "near wall"'
    assert walls(tmp_path, lens, focus_at=(60, 32)).camera.focus_distance == pytest.approx(4.0, rel=1e-5)
    assert walls(tmp_path, lens, focus_distance=7.0).camera.focus_distance == 7.0


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"focus_on": "far wal"}, "--focus-on: 'far wal' is no object, node or material of the scene; did you mean 'far wall'"),
        ({"focus_at": (64, 3)}, "--focus-at: 64,3 lies outside the frame of 64x64 pixels"),
        ({"focus_at": (0.9, 0.1), "camera_target": (0.0, 5.0, -1.0)}, "--focus-at: nothing but background at 0.9,0.1"),
        ({"focus_on": "clay", "camera_target": (0.0, 0.0, 1.0)}, "--focus-on: 'clay' is not visible in the frame"),
        ({"focus_on": "clay", "focus_distance": 2.0}, "keep one"),
    ],
    ids=str,
)
def test_where_there_is_nothing_one_line_says_so(tmp_path, overrides, message):
    with pytest.raises(BokehguideError) as caught:
        walls(tmp_path, **overrides)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_f_number_is_focal_length_by_diameter_everywhere(tmp_path):
    focal = 0.018 / math.tan(math.radians(45.0))  # metres, on a sensor 36 mm wide
    assert walls(tmp_path, "f_number = 2.0").camera.aperture_radius == pytest.approx(focal / 4.0)
    assert walls(tmp_path, f_number=2.0).camera.aperture_radius == pytest.approx(focal / 4.0)
    assert walls(tmp_path, "f_number = 2.0\nsensor_width = 24.0").camera.aperture_radius == pytest.approx(focal / 4.0 * 24 / 36)
    narrow = walls(tmp_path, "f_number = 2.0", fov=30.0).camera
    assert narrow.f_number == pytest.approx(2.0) and narrow.aperture_radius > focal / 4.0, "the f-number stays"
    text = TWO_WALLS.replace("fov = 90.0", "focal_length = 50.0").format(lens="f_number = 2.0")
    (tmp_path / "long.toml").write_text(text)
    assert load_scene(str(tmp_path / "long.toml")).camera.aperture_radius == pytest.approx(0.0125)


def test_options_replace_single_fields_of_the_aperture(tmp_path):
    lens = "aperture_radius = 0.1\naperture = { blades = 6, cat_eye = 0.5 }"
    aperture = walls(tmp_path, lens, aperture_blades=5, aperture_edge=0.25).camera.aperture
    assert aperture == Aperture(blades=5, cat_eye=0.5, edge=0.25)
    scene = walls(tmp_path)
    mask = np.ones((4, 4), np.float32)
    own = replace(scene, camera=replace(scene.camera, aperture=Aperture(image=mask)))
    turned = load_scene(own, Overrides(aperture_rotation=30.0)).camera.aperture
    assert turned.rotation == 30.0 and np.array_equal(turned.image, mask), "a mask of a Scene stays"
    with pytest.raises(BokehguideError, match=r"--aperture-blades: 2 is out of range"):
        walls(tmp_path, aperture_blades=2)
