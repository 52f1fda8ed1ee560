"""Exposure, views and denoising from the command line."""

import colorsys
import json
import shlex
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import trimesh
from PIL import Image

from bokehguide.cli import main
from bokehguide.image import metered_exposure, read_exr, read_metadata, read_rgb, write_exr
from tests.support.scene_text import BOX_AND_EMITTER

RED_LAMP = BOX_AND_EMITTER.replace("[40.0, 30.0, 20.0]", "[4000.0, 300.0, 100.0]")


def png(path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture) / 255.0


def saturation(path, radiance: np.ndarray) -> float:
    """Mean HSV saturation over the pixels of the lamp's disc."""
    disc = radiance[..., 0] > 0.2 * np.quantile(radiance[..., 0], 0.98)
    assert 30 < disc.sum() < 300
    return float(np.mean([colorsys.rgb_to_hsv(*color)[1] for color in png(path)[disc]]))


@pytest.fixture
def rendered(tmp_path, monkeypatch):
    """A folder with a render of a red lamp out of focus, `a.exr`."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "red.toml").write_text(RED_LAMP)
    assert main(["render", "red.toml", "--spp", "6", "--out", "a.exr"]) == 0
    return tmp_path


def test_a_red_lamp_is_red_by_default(rendered, capsys):
    radiance = read_rgb("a.exr")
    assert saturation("a.png", radiance) >= 0.25
    assert main(["develop", "a.exr", "--exposure", "0", "--out", "b.png"]) == 0
    assert saturation("b.png", radiance) >= 0.25
    assert main(["develop", "a.exr", "--exposure", "0", "--view", "srgb", "--out", "c.png"]) == 0
    assert saturation("c.png", radiance) < 0.2
    assert "wrote c.png, exposure +0 EV, view srgb" in capsys.readouterr().out


def test_the_metered_exposure_is_stored_and_developed_again(rendered, capsys):
    header, channels = read_metadata("a.exr"), read_exr("a.exr")
    metered = metered_exposure(read_rgb("a.exr"), channels["A"])
    assert header["exposure"] == pytest.approx(metered) and header["display_view"] == "photo"
    first = png("a.png")
    assert main(["develop", "a.exr", "--exposure", "auto"]) == 0
    np.testing.assert_array_equal(png("a.png"), first)
    assert main(["render", "red.toml", "--spp", "1", "--exposure", "-2.5", "--view", "aces", "--out", "b.exr"]) == 0
    shown = png("b.png")
    capsys.readouterr()
    assert main(["develop", "b.exr"]) == 0
    assert capsys.readouterr().out == "wrote b.png, exposure -2.5 EV, view aces\n"
    np.testing.assert_array_equal(png("b.png"), shown)


def test_the_scene_file_sets_the_exposure_and_the_option_wins(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").write_text(RED_LAMP.replace("max_depth = 3", "max_depth = 3\nexposure = -1.5"))
    for options, expected in (([], -1.5), (["--exposure", "2"], 2.0)):
        assert main(["render", "a.toml", "--spp", "1", "--mode", "uniform", "--out", "a.exr", *options]) == 0
        assert read_metadata("a.exr")["exposure"] == expected
    (tmp_path / "a.toml").write_text(RED_LAMP.replace("max_depth = 3", 'max_depth = 3\nexposure = "bright"'))
    capsys.readouterr()
    assert main(["render", "a.toml"]) == 2
    assert "film.exposure: 'bright' is not a number; give EV from -100 to 100, or \"auto\"" in capsys.readouterr().err


def test_a_transparent_png_of_8_and_16_bits(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    hidden = RED_LAMP.replace("[environment]", "[environment]\nvisible = false").replace("scale = 6.0", "scale = 1.0")
    (tmp_path / "red.toml").write_text(hidden)
    command = ["render", "red.toml", "--mode", "uniform", "--spp", "4", "--exposure", "1"]
    assert main([*command, "--alpha", "--out", "a.exr"]) == 0
    assert "--alpha" in read_metadata("a.exr")["command"] and "--bits" not in read_metadata("a.exr")["command"]
    with Image.open("a.png") as picture:
        assert picture.mode == "RGBA"
    shown, alpha = png("a.png"), read_exr("a.exr")["A"]
    edge = (alpha > 0.0) & (alpha < 1.0)
    assert edge.any() and (alpha == 0.0).any() and (alpha == 1.0).any()
    np.testing.assert_allclose(shown[..., 3], alpha, atol=0.5 / 255 + 1e-6)
    assert main(["develop", "a.exr", "--out", "opaque.png"]) == 0
    opaque = png("opaque.png")
    assert opaque.shape[2] == 3
    np.testing.assert_array_equal(shown[alpha == 1.0][:, :3], opaque[alpha == 1.0])
    assert not shown[alpha == 0.0].any() and (shown[edge][:, :3].mean() > opaque[edge].mean())
    assert main(["develop", "a.exr", "--alpha", "--out", "b.png"]) == 0
    assert Path("b.png").read_bytes() == Path("a.png").read_bytes()
    assert main([*command, "--alpha", "--bits", "16", "--out", "c.exr"]) == 0
    assert "--bits=16" in read_metadata("c.exr")["command"]
    assert main(["develop", "a.exr", "--alpha", "--bits", "16", "--out", "d.png"]) == 0
    assert Path("c.png").read_bytes() == Path("d.png").read_bytes()
    fine = oiio.ImageBuf("d.png")
    assert fine.spec().nchannels == 4 and fine.spec().format == oiio.UINT16


@pytest.fixture
def ball(tmp_path, monkeypatch):
    """The command that renders a model without a camera and without light."""
    monkeypatch.chdir(tmp_path)
    trimesh.creation.icosphere(3, 0.5).export("ball.glb")
    return ["render", "ball.glb", "--mode", "uniform", "--size", "48x27", "--spp", "4", "--out", "a.exr"]


def test_the_sky_of_a_model_is_hidden_from_the_camera(ball, capsys):
    assert main(ball) == 0
    under_sky = read_rgb("a.exr")
    assert main([*ball, "--hide-environment", "--alpha"]) == 0
    assert "opaque" not in capsys.readouterr().err
    alpha, hidden = png("a.png")[..., 3], read_rgb("a.exr")
    assert not hidden[alpha == 0.0].any() and (alpha == 0.0).sum() > 100
    np.testing.assert_array_equal(hidden[alpha == 1.0], under_sky[alpha == 1.0])
    assert (alpha == 1.0).sum() > 100 and hidden[alpha == 1.0].min() > 0.05


def test_the_command_in_the_header_hides_the_environment(ball):
    assert main([*ball, "--hide-environment"]) == 0
    first, words = Path("a.exr").read_bytes(), shlex.split(read_metadata("a.exr")["command"])
    assert "--hide-environment" in words
    assert main([*words[1:], "--out", "a.exr"]) == 0
    assert Path("a.exr").read_bytes() == first


def test_a_model_without_an_environment(ball, capsys):
    assert main([*ball, "--environment", "none", "--alpha"]) == 0
    assert "warning: nothing shines, so that the picture is black; add an environment" in capsys.readouterr().err
    assert not read_rgb("a.exr").any()
    alpha = png("a.png")[..., 3]
    assert (alpha == 0.0).sum() > 100 < (alpha == 1.0).sum()


def test_a_transparent_png_that_is_opaque_is_told(rendered, capsys):
    told = "bokehguide: warning: --alpha: the picture is opaque everywhere; `bokehguide render` with --hide-environment"
    assert main(["develop", "a.exr", "--alpha"]) == 0
    assert capsys.readouterr().err == f"{told} hides the environment from the camera\n"
    assert main(["render", "red.toml", "--spp", "1", "--alpha", "--out", "b.exr"]) == 0
    assert capsys.readouterr().err.count(told) == 1
    assert main(["render", "red.toml", "--spp", "1", "--out", "b.exr"]) == 0
    assert told not in capsys.readouterr().err


def test_a_transparent_png_needs_alpha(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_exr("a.exr", {"beauty": np.full((4, 6, 3), 0.5, np.float32)})
    assert main(["develop", "a.exr", "--alpha"]) == 2
    assert "error: --alpha: a.exr has no channel A; leave --alpha out, or" in capsys.readouterr().err
    assert main(["develop", "a.exr", "--bits", "12"]) == 2
    assert "argument --bits: '12' is no depth of a PNG; give 8 or 16" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_a_picture_that_was_denoised_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_exr("a.exr", {"beauty": np.full((4, 6, 3), 0.5, np.float32), "denoised": np.full((4, 6, 3), 0.4, np.float32)})
    assert main(["develop", "a.exr"]) == 0
    assert capsys.readouterr().err == "bokehguide: the PNG shows the noisy picture of a.exr; --denoise shows the denoised one\n"
    assert main(["develop", "a.exr", "--denoise"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_a_denoised_render_has_both_pictures(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mitsuba_oidn")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "red.toml").write_text(RED_LAMP)
    options = ["red.toml", "--mode", "lis-o", "--spp", "6", "--seed", "3", "--exposure", "-3"]
    assert main(["render", *options, "--out", "a.exr"]) == 0
    assert main(["render", *options, "--denoise", "--out", "b.exr", "--json", "b.json"]) == 0
    plain, both = read_exr("a.exr"), read_exr("b.exr")
    assert both.keys() - plain.keys() == {"denoised.R", "denoised.G", "denoised.B"}
    for name, plane in plain.items():  # alpha among them
        np.testing.assert_array_equal(both[name], plane, err_msg=name)
    assert np.abs(both["denoised.R"] - both["R"]).max() > 0.0
    assert (png("a.png") != png("b.png")).any()
    assert 0.0 < json.loads((tmp_path / "b.json").read_text())["estimated_mape"] < 1.0
    assert "--denoise" in read_metadata("b.exr")["command"]
    shown = png("b.png")
    assert main(["develop", "b.exr", "--denoise"]) == 0
    np.testing.assert_array_equal(png("b.png"), shown)
    assert main(["develop", "b.exr"]) == 0
    np.testing.assert_array_equal(png("b.png"), png("a.png"))
    assert main(["develop", "a.exr", "--denoise", "--out", "c.png"]) == 0  # by its variance
    assert (png("c.png") != png("a.png")).any()


@pytest.mark.slow
def test_a_resumed_denoised_render_has_the_same_bits(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mitsuba_oidn")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "red.toml").write_text(RED_LAMP)
    whole, first = (["render", "red.toml", "--denoise", "--spp", spp, "--out"] for spp in ("5", "3"))
    assert main([*whole, "a.exr"]) == 0 and main([*first, "b.exr", "--checkpoint-every", "100"]) == 0
    assert main([*whole, "b.exr", "--resume"]) == 0
    assert "resuming" in capsys.readouterr().err
    one, two = read_exr("a.exr"), read_exr("b.exr")
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


def test_the_noise_target_reports_the_denoised_picture(tmp_path, monkeypatch):
    pytest.importorskip("mitsuba_oidn")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "red.toml").write_text(RED_LAMP)
    found = {}
    for name, options in (("noisy", []), ("denoised", ["--denoise"])):
        arguments = ["render", "red.toml", "--spp", "4", "--target-noise", "0.01", *options, "--out", "a.exr", "--json", "a.json"]
        assert main(arguments) == 0
        found[name] = json.loads((tmp_path / "a.json").read_text())["estimated_mape"]
    assert 0.0 < found["denoised"] < found["noisy"]


def test_the_first_step_of_a_noise_target_is_denoised_as_of_any_render(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mitsuba_oidn")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "red.toml").write_text(RED_LAMP)
    options = ["render", "red.toml", "--denoise", "--threads", "1"]
    assert main([*options, "--spp", "1", "--out", "plain.exr"]) == 0
    assert main([*options, "--spp", "1", "--target-noise", "0.01", "--out", "target.exr"]) == 0
    assert main([*options, "--spp", "2", "--target-noise", "0.01", "--out", "more.exr"]) == 0
    assert "warning" not in capsys.readouterr().err
    plain, target = read_exr("plain.exr"), read_exr("target.exr")
    assert "denoised.R" in plain and plain.keys() == target.keys()
    for name, plane in plain.items():
        np.testing.assert_array_equal(target[name], plane, err_msg=name)


BAD = {
    "missing": (["develop", "no.exr"], "no.exr: cannot be read (No such file or directory)"),
    "no EXR": (["develop", "text.exr"], "text.exr: is not an EXR file"),
    "no picture": (["develop", "depth.exr"], "depth.exr: has no channels R, G and B"),
    "no layers": (["develop", "plain.exr", "--denoise"], "plain.exr: --denoise needs the layers variance, albedo, normal"),
    "a folder": (["develop", "plain.exr", "--out", "folder.png"], "folder.png: is a folder"),
    "no PNG": (["develop", "plain.exr", "--out", "a.jpg"], "'a.jpg' is no PNG"),
    "view": (["develop", "plain.exr", "--view", "agx"], "invalid choice: 'agx'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_give_one_line(case, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.exr").write_text("text")
    (tmp_path / "folder.png").mkdir()
    write_exr("depth.exr", {"depth": np.ones((2, 2), np.float32)})
    write_exr("plain.exr", {"beauty": np.ones((2, 2, 3), np.float32)}, {"exposure": "much", "display_view": "agx"})
    arguments, message = BAD[case]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert main(["develop", "plain.exr"]) == 0  # a header that does not fit is ignored


def test_a_folder_is_created_in_an_existing_one_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_exr("plain.exr", {"beauty": np.ones((2, 2, 3), np.float32)})
    assert main(["develop", "plain.exr", "--out", "new/deep/a.png"]) == 2 and not (tmp_path / "new").exists()
    assert "the folder new does not exist" in capsys.readouterr().err
    assert main(["develop", "plain.exr", "--out", "new/a.png"]) == 0 and (tmp_path / "new/a.png").exists()
    assert "created the folder new" in capsys.readouterr().err
