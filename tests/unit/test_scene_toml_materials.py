"""Scene files: material terms, suns, invisible environments, and the text of `info`."""

import math

import numpy as np
import pytest
from PIL import Image

from bokehguide.scene import load_scene
from bokehguide.scene.summary import summarize
from bokehguide.scene.types import Cone, Material, Sun
from tests.support.scene_text import BALL, CAMERA, load

TEXTURES = (
    *("base_color", "metallic_roughness", "emission", "normal", "specular", "specular_color"),
    *("transmission", "clearcoat", "clearcoat_roughness", "clearcoat_normal", "sheen_color", "sheen_roughness", "anisotropy"),
    *("diffuse_transmission", "diffuse_transmission_color", "iridescence", "iridescence_thickness"),
)


@pytest.fixture
def folder(tmp_path):
    Image.new("RGBA", (2, 1), (188, 0, 255, 51)).save(tmp_path / "paint.png")
    Image.new("RGB", (2, 1), (188, 0, 255)).save(tmp_path / "plain.png")
    return tmp_path


def material(folder, lines: str) -> Material:
    (found,) = load(folder, CAMERA + BALL.replace("base_color = [0.5, 0.5, 0.5]", lines)).materials
    return found


def test_every_term_reaches_the_material(folder):
    found = material(
        folder,
        """
        specular_color = [0.5, 1.5, 1.0]
        transmission = 0.9
        attenuation_color = [0.1, 0.2, 0.3]
        attenuation_distance = 0.25
        clearcoat = 0.75
        clearcoat_roughness = 0.125
        emission = [1.0, 2.0, 3.0]
        emission_cone = { axis = [0.0, -2.0, 0.0], inner = 10.0, outer = 30, smooth = true }
        opacity = 0.5
        alpha_mode = "mask"
        alpha_cutoff = 0.25
        normal_scale = -2.0
        normal_texture = "plain.png"
        clearcoat_normal_scale = 3.0
        clearcoat_normal_texture = "plain.png"
        sheen_color = [0.25, 0.5, 1.0]
        sheen_roughness = 0.6
        anisotropy = 0.7
        anisotropy_rotation = -20.0
        diffuse_transmission = 0.3
        diffuse_transmission_color = [0.1, 0.9, 0.4]
        iridescence = 0.6
        iridescence_ior = 1.7
        iridescence_thickness = [50, 950]
        dispersion = 1.5
        metallic = 0.5
        single_scattering = true
        """,
    )
    assert found.specular_color == (0.5, 1.5, 1.0) and found.transmission == 0.9
    assert found.attenuation_color == (0.1, 0.2, 0.3) and found.attenuation_distance == 0.25
    assert (found.clearcoat, found.clearcoat_roughness) == (0.75, 0.125)
    assert found.emission_cone == Cone((0.0, -1.0, 0.0), 10.0, 30.0, smooth=True)
    assert (found.opacity, found.alpha_mode, found.alpha_cutoff) == (0.5, "mask", 0.25)
    assert (found.normal_scale, found.clearcoat_normal_scale) == (-2.0, 3.0)
    assert (found.sheen_color, found.sheen_roughness) == ((0.25, 0.5, 1.0), 0.6)
    assert (found.iridescence, found.iridescence_ior, found.iridescence_thickness) == (0.6, 1.7, (50.0, 950.0))
    assert found.dispersion == 1.5 and found.single_scattering
    assert (found.anisotropy, found.anisotropy_rotation) == (0.7, -20.0)
    assert (found.diffuse_transmission, found.diffuse_transmission_color) == (0.3, (0.1, 0.9, 0.4))


def test_terms_that_are_left_out_have_their_defaults(folder):
    assert material(folder, "") == Material("grey")


def test_every_texture_is_read_as_it_is_encoded(folder):
    lines = "\n".join(f'{name}_texture = "paint.png"' for name in TEXTURES)
    found = material(folder, lines + "\nemission = [1, 1, 1]")
    for name in TEXTURES:
        image = getattr(found, f"{name}_texture").image
        encoded = name in ("base_color", "emission", "specular_color", "sheen_color", "diffuse_transmission_color")
        assert image[0, 0, 0] == pytest.approx(0.5029 if encoded else 188 / 255, abs=1e-4), name
        assert image.shape[2] == (4 if name in ("specular", "sheen_roughness", "diffuse_transmission") else 3), name
    assert found.specular_texture.image[0, 1, 3] == pytest.approx(0.2)
    assert (found.transmission, found.clearcoat, found.clearcoat_roughness, found.specular) == (1.0,) * 4
    assert (found.sheen_roughness, found.anisotropy, found.diffuse_transmission, *found.sheen_color) == (1.0,) * 6


@pytest.mark.parametrize("mode, channels", [("opaque", 3), ("mask", 4), ("blend", 4)])
def test_the_base_colours_alpha_is_kept_where_it_counts(folder, mode, channels):
    found = material(folder, f'base_color_texture = "paint.png"\nalpha_mode = "{mode}"')
    assert found.base_color_texture.image.shape[2] == channels and found.alpha_mode == mode
    if channels == 4:
        np.testing.assert_allclose(found.base_color_texture.image[..., 3], 0.2, rtol=1e-6)


def test_suns(tmp_path):
    text = (
        CAMERA
        + BALL
        + """
[[sun]]
direction = [0.0, 3.0, 4.0]
irradiance = [3.0, 2.0, 1.0]
[[sun]]
direction = [-1e-3, 0.0, 0.0]
irradiance = [0, 0, 1]
angle = 2
"""
    )
    low, wide = load(tmp_path, text).suns
    assert low == Sun((0.0, 0.6, 0.8), 0.53, (3.0, 2.0, 1.0))
    assert wide == Sun((-1.0, 0.0, 0.0), 2.0, (0.0, 0.0, 1.0))


@pytest.mark.parametrize("line, visible", [("", True), ("visible = true", True), ("visible = false", False)])
def test_whether_the_environment_is_visible(tmp_path, line, visible):
    scene = load(tmp_path, CAMERA + BALL + f"[environment]\ncolor = [1, 1, 1]\n{line}\n")
    assert scene.environment.visible == visible


def info_of(tmp_path, lines: str, environment: str = "") -> str:
    ball = BALL.replace("base_color = [0.5, 0.5, 0.5]", lines)
    text = CAMERA + "aperture_radius = 0.1\n" + ball + environment
    (tmp_path / "scene.toml").write_text(text)
    return summarize(load_scene(str(tmp_path / "scene.toml")))


def test_info_names_opacity_coats_and_absorption(tmp_path):
    plain = info_of(tmp_path, "")
    assert "1 (grey)\n" in plain
    rich = info_of(
        tmp_path,
        'opacity = 0.5\nalpha_mode = "blend"\nclearcoat = 1.0\ntransmission = 1.0\n'
        "attenuation_color = [0.5, 0.5, 0.5]\nattenuation_distance = 1.0",
    )
    assert "1 (grey); 1 blended; 1 clear-coated; 1 absorbing\n" in rich


def test_info_shows_suns_and_their_coverage_of_the_lens(tmp_path):
    sun = "[[sun]]\ndirection = [0, 0.1, -1]\nirradiance = [3, 2, 1]\n"
    shown = info_of(tmp_path, "", sun)
    assert "sun 0.53° across, irradiance (3, 2, 1), towards (0, 0.0995, -0.995); no environment" in shown
    # From its bokeh, through a point in focus 6 m away, a sun 5.7° off the axis covers this of a lens of 0.1 m.
    share = 100.0 * (6.0 * math.tan(math.radians(0.265)) / 0.995 / 0.1) ** 2
    assert f"{share:.3g} % of the lens" in shown
    hidden = info_of(tmp_path, "", sun + "[environment]\ncolor = [1, 1, 1]\nvisible = false\n")
    assert "environment of colour (1, 1, 1), not visible to the camera" in hidden
    assert "no emitter in the frame" in hidden
