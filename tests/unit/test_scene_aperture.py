"""`[camera.aperture]` of a scene file: valid and invalid values, the text of `info`, and fingerprints."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import Aperture, Overrides, load_scene, summarize
from bokehguide.scene.digest import contents
from bokehguide.train import RenderSettings, describe_render

GOOD = """
[camera]
position = [0.0, 1.0, 6.0]
target = [0.0, 1.0, 0.0]
aperture_radius = 0.1
[camera.aperture]
SHAPE
[materials.grey]
[[object]]
shape = "sphere"
material = "grey"
"""


def scene(folder, shape: str, overrides: Overrides | None = None, text: str = GOOD):
    path = folder / "scene.toml"
    path.write_text(text.replace("SHAPE", shape))
    return load_scene(str(path), overrides or Overrides())


def test_every_key(tmp_path):
    shape = "blades = 5\nrotation = 36\ncurvature = 0.25\nratio = 1.8\ncat_eye = 0.7\nedge = -0.5"
    expected = Aperture(blades=5, rotation=36.0, curvature=0.25, ratio=1.8, cat_eye=0.7, edge=-0.5)
    assert scene(tmp_path, shape).camera.aperture == expected
    moved = scene(tmp_path, shape, Overrides(f_number=2.0, camera_position=(0.0, 2.0, 6.0))).camera
    assert moved.aperture == expected and moved.aperture_radius != 0.1


def test_without_a_table_the_aperture_is_round(tmp_path):
    text = GOOD.replace("[camera.aperture]\nSHAPE\n", "")
    assert scene(tmp_path, "", text=text).camera.aperture is None


def test_an_image_is_read_as_it_stands_times_its_opacity(tmp_path):
    texels = np.array([[[255, 255, 255, 255], [51, 51, 51, 255]], [[255, 255, 255, 102], [0, 0, 0, 255]]], np.uint8)
    Image.fromarray(texels).save(tmp_path / "mask.png")
    image = scene(tmp_path, 'image = "mask.png"\nrotation = 90').camera.aperture.image
    np.testing.assert_allclose(image, [[1.0, 0.2], [0.4, 0.0]], atol=1e-6)
    assert image.dtype == np.float32
    Image.fromarray(texels[..., 0]).save(tmp_path / "mask.png")
    np.testing.assert_allclose(scene(tmp_path, 'image = "mask.png"').camera.aperture.image, [[1.0, 0.2], [1.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        ("blades = 2", ["camera.aperture.blades", "2", "from 3 to 64"]),
        ("blades = 65", ["camera.aperture.blades", "65"]),
        ("blades = -1", ["camera.aperture.blades", "-1"]),
        ("blades = 5.0", ["camera.aperture.blades", "5.0", "whole number"]),
        ("blades = true", ["camera.aperture.blades", "True"]),
        ("blades = 5\nrotation = nan", ["camera.aperture.rotation", "nan"]),
        ("rotation = 10", ["camera.aperture.rotation", "10", "blades or image"]),
        ("blades = 0\nrotation = 10", ["camera.aperture.rotation", "blades or image"]),
        ("curvature = 0.5", ["camera.aperture.curvature", "0.5", "blades"]),
        ("blades = 5\ncurvature = 1.1", ["camera.aperture.curvature", "1.1", "between 0 and 1"]),
        ("ratio = 0", ["camera.aperture.ratio", "0", "between 0.1 and 10"]),
        ("cat_eye = 2.0", ["camera.aperture.cat_eye", "2.0", "between 0 and 1.5"]),
        ("edge = -2", ["camera.aperture.edge", "-2", "between -1 and 1"]),
        ("blade = 5", ["camera.aperture.blade", "unknown key", "did you mean 'blades'?"]),
        ('image = "mask.png"\nblades = 5', ["camera.aperture.image", "blades", "keep one"]),
        ('image = "mask.png"\nedge = 0.5', ["camera.aperture.image", "edge", "keep one"]),
        ('image = "mask.png"\ncurvature = 0.5', ["camera.aperture.image", "curvature", "keep one"]),
        ('image = "none.png"', ["none.png", "no such file"]),
        ('image = "scene.toml"', ["scene.toml", "unreadable"]),
        ('image = "black.png"', ["camera.aperture.image", "black.png", "no light"]),
        ('image = ""', ["camera.aperture.image", "not a text"]),
        ("image = 3", ["camera.aperture.image", "3", "not a text"]),
    ],
)
def test_errors_take_one_line(tmp_path, shape, named):
    Image.new("L", (4, 4), 255).save(tmp_path / "mask.png")
    Image.new("L", (4, 4), 0).save(tmp_path / "black.png")
    with pytest.raises(BokehguideError) as caught:
        scene(tmp_path, shape)
    assert len(str(caught.value).splitlines()) == 1
    for part in ("scene.toml", *named) if "png" not in named[0] else named:
        assert part in str(caught.value)


def test_a_shape_needs_a_size(tmp_path):
    with pytest.raises(BokehguideError, match=r"camera.aperture: .* pinhole; give f_number or aperture_radius"):
        scene(tmp_path, "blades = 5", text=GOOD.replace("aperture_radius = 0.1\n", ""))
    with pytest.raises(BokehguideError, match=r"camera.aperture: 5 is not a table"):
        scene(tmp_path, "", text=GOOD.replace("[camera.aperture]\nSHAPE", "aperture = 5"))


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ("blades = 5\nrotation = 36\ncurvature = 0.25", "5 blades of curvature 0.25, rotated by 36°"),
        (
            "ratio = 2\nedge = -0.5\ncat_eye = 0.7",
            "round, its width divided by 2, centre brighter by 0.5, cat's eyes of 0.7 radii",
        ),
        ('image = "mask.png"', "a mask of 4 × 3 texels"),
    ],
)
def test_info_shows_the_shape(tmp_path, shape, said):
    Image.new("L", (4, 3), 255).save(tmp_path / "mask.png")
    assert said in summarize(scene(tmp_path, shape))


def test_a_file_s_header_names_the_shape(tmp_path):
    Image.new("L", (4, 3), 255).save(tmp_path / "mask.png")
    facts = describe_render(scene(tmp_path, 'image = "mask.png"\ncat_eye = 0.5'), RenderSettings(), 1)
    told = json.loads(facts["settings"])["camera"]["aperture"]
    assert told["image"] == "4 × 3 texels" and told["cat_eye"] == 0.5


def test_a_field_that_is_round_leaves_kept_renders_valid(tmp_path):
    """A digest made before there were apertures is the same; another shape has another one."""
    one = load_scene("cutout", Overrides(width=32, height=18)).camera
    assert b"aperture" not in list(contents(one))
    shapes = [
        Aperture(blades=5),
        Aperture(blades=6),
        Aperture(image=np.ones((2, 2), np.float32)),
        Aperture(image=np.eye(2, dtype=np.float32)),
    ]
    digests = {b"".join(contents(replace(one, aperture=shape))) for shape in (None, *shapes)}
    assert len(digests) == 5
