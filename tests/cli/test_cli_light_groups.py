"""`bokehguide render --light-groups`: layers that other programs read, resumed renders, and mistakes."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

import bokehguide
from bokehguide.cli import main
from bokehguide.image import read_exr, read_layers, read_metadata
from bokehguide.scene import load_scene
from tests.support.same_bits import assert_same_layers

SCENE = """
[camera]
position = [0.0, 0.5, 3.0]
target = [0.0, 0.3, 0.0]
aperture_radius = 0.05
focus_distance = 3.0

[film]
width = 32
height = 18

[environment]
color = [0.1, 0.12, 0.2]
group = "sky"

[[sun]]
direction = [0.3, 0.8, 0.4]
irradiance = [0.5, 0.4, 0.3]
group = "lamps"

[materials.floor]
roughness = 0.4

[materials.sign]
emission = [0.5, 2.0, 3.0]
double_sided = true
group = "sign"

[[object]]
shape = "rectangle"
material = "floor"
rotate = [-90.0, 0.0, 0.0]
scale = 5.0

[[object]]
shape = "rectangle"
material = "sign"
scale = 0.4
translate = [-0.6, 0.5, -0.5]

[[light]]
group = "lamps"
positions = [[0.4, 0.6, -2.0], [0.8, 0.8, -3.0]]
radius = 0.05
watts = 3.0

[[light]]
position = [0.0, 0.8, -1.0]
radius = 0.03
watts = 1.0
"""
NAMES = ("sign", "lamps", "sky", "ungrouped")
CHANNELS = {f"Combined_{name}.{channel}" for name in NAMES for channel in "RGB"}


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The current folder, with `lit.toml`."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lit.toml").write_text(SCENE)
    return tmp_path


def render(*options: object) -> int:
    return main(["render", "lit.toml", "--threads", "1", *map(str, options)])


@pytest.mark.parametrize("mode", ["uniform", "lis-o", "guided"])
def test_other_programs_read_layers_that_add_up(folder, mode):
    assert render("--mode", mode, "--spp", 6, "--light-groups", "--out", "a.exr") == 0
    channels = OpenEXR.File("a.exr", separate_channels=True).channels()
    assert {name for name in channels if name.startswith("Combined_")} == CHANNELS
    assert set(oiio.ImageBuf("a.exr").spec().channelnames) >= CHANNELS
    for channel in "RGB":
        layers = [channels[f"Combined_{name}.{channel}"].pixels for name in NAMES]
        assert all(layer.max() > 0.01 for layer in layers)
        np.testing.assert_allclose(sum(layers), channels[channel].pixels, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("suffix", ["command", "python"])
def test_compositors_read_windows_colours_and_long_names(folder, suffix):
    """The file as OpenImageIO reads it, with every kind of layer, a crop, and a name of more than 31 characters."""
    pytest.importorskip("mmh3")
    long = "lamps_along_the_wall_of_the_garden"
    (folder / "lit.toml").write_text(SCENE.replace('"lamps"', f'"{long}"'))
    if suffix == "command":
        assert render("--spp", 3, "--light-groups", "--cryptomatte", "--crop", "4,3,20,12", "--out", "a.exr") == 0
    else:
        options = {"light_groups": True, "cryptomatte": True, "crop": (4, 3, 20, 12), "quiet": True, "threads": 1}
        bokehguide.render("lit.toml", spp=3, **options).save("a.exr")
    spec = oiio.ImageBuf("a.exr").spec()
    assert (spec.x, spec.y, spec.width, spec.height) == (4, 3, 20, 12), "data window"
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, 32, 18), "display window"
    assert all(re.fullmatch(r"[RGBA]|[A-Za-z]\w*\.[RGBAXYZ]", name) for name in spec.channelnames), "layer.channel"
    assert spec.channelnames[:4] == ("R", "G", "B", "A") and spec.alpha_channel == 3
    assert {f"Combined_{long}.R", "CryptoObject02.A", "CryptoMaterial00.R", "depth.Z"} < set(spec.channelnames)
    assert spec.format == oiio.FLOAT and not spec.channelformats, "identifiers of mattes need all 32 bits"
    assert spec["compression"] == "zip" and spec["PixelAspectRatio"] == 1.0
    assert spec["chromaticities"] == pytest.approx((0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329))
    assert spec["oiio:ColorSpace"] == "lin_rec709_scene"
    assert spec.getattribute("view") is None, "a stereo attribute: compositors would look for an eye of this name"
    assert spec["display_view"] == "photo"
    flags = int.from_bytes((folder / "a.exr").read_bytes()[4:8], "little")
    assert flags & 0x400, "the flag of names longer than 31 characters"


def test_other_layers_are_unchanged_and_the_command_is_kept(folder):
    assert render("--spp", 3, "--out", "plain.exr") == 0 and render("--spp", 3, "--light-groups", "--out", "a.exr") == 0
    plain, found = read_exr("plain.exr"), read_exr("a.exr")
    assert found.keys() - plain.keys() == CHANNELS
    assert_same_layers(found, plain)
    command = shlex.split(read_metadata("a.exr")["command"])
    assert command.count("--light-groups") == 1 and "--light-groups" not in read_metadata("plain.exr")["command"]
    assert main([*command[1:], "--threads", "1", "--out", "b.exr"]) == 0
    assert_same_layers(found, read_exr("b.exr"))


@pytest.mark.parametrize("options", [("--mode", "guided"), ("--mode", "lis-o", "--target-noise", 0.3, "--crop", "4,3,20,12")])
def test_a_resumed_render_has_the_same_layers(folder, options, capsys):
    options = (*options, "--light-groups")
    assert render(*options, "--spp", 20, "--out", "whole.exr") == 0
    assert render(*options, "--spp", 9, "--out", "part.exr", "--checkpoint-every", 100) == 0
    assert render(*options[:-1], "--spp", 20, "--out", "part.exr", "--resume") == 2
    assert "other light groups" in capsys.readouterr().err
    assert render(*options, "--spp", 20, "--out", "part.exr", "--resume") == 0
    whole, part = read_exr("whole.exr"), read_exr("part.exr")
    assert_same_layers(part, whole)


def test_python_gives_the_layers_by_name(folder):
    picture = bokehguide.render("lit.toml", spp=3, light_groups=True, quiet=True, threads=1)
    assert tuple(picture.light_groups) == NAMES
    np.testing.assert_allclose(sum(picture.light_groups.values()), picture.beauty, rtol=1e-4, atol=1e-5)
    layers, _ = read_layers(picture.save("a.exr"))
    np.testing.assert_array_equal(layers["Combined_sign"], picture.light_groups["sign"])
    assert not bokehguide.render("lit.toml", spp=1, quiet=True).light_groups


def test_a_model_has_one_group(folder):
    (folder / "lamp.obj").write_text("mtllib lamp.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl bulb\nf 1 2 3\n")
    (folder / "lamp.mtl").write_text("newmtl bulb\nKe 3 2 1\n")
    objects = '\n[[object]]\nfile = "lamp.obj"\ngroup = "{}"\ntranslate = [{}, 0.2, 0.0]\n'
    (folder / "lit.toml").write_text(SCENE + objects.format("left", -1.0) + objects.format("right", 1.0))
    groups = bokehguide.render("lit.toml", mode="uniform", spp=4, light_groups=True, quiet=True).light_groups
    assert {"left", "right"} <= groups.keys()
    assert groups["left"][:, :16].max() > 1.0 > groups["left"][:, 16:].max()
    assert groups["right"][:, 16:].max() > 1.0 > groups["right"][:, :16].max()


def test_a_group_of_a_model_without_lights_is_told(folder, capsys):
    (folder / "dark.obj").write_text("mtllib dark.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl wall\nf 1 2 3\n")
    (folder / "dark.mtl").write_text("newmtl wall\nKd 0.5 0.5 0.5\n")
    (folder / "lit.toml").write_text(SCENE + '\n[[object]]\nfile = "dark.obj"\ngroup = "model"\n')
    number = SCENE.count("[[object]]")
    assert main(["render", "lit.toml", "--mode=uniform", "--spp=1", "--light-groups", "--out=a.exr"]) == 0
    assert f"warning: object[{number}].group: has no effect, as the object has no lights" in capsys.readouterr().err
    (folder / "dark.mtl").write_text("newmtl wall\nKe 0.5 0.5 0.5\n")
    assert not load_scene("lit.toml").warnings
    (folder / "lit.toml").write_text(SCENE + '\n[[object]]\nfile = "dark.obj"\ngroup = "model"\nmaterial = "floor"\n')
    assert len(load_scene("lit.toml").warnings) == 1, "the material of the object replaces that of the model"


@pytest.mark.parametrize(
    "old, new, message",
    [
        (
            'group = "sign"',
            'group = "neon sign"',
            "lit.toml: materials.sign.group: 'neon sign' is no name of a light group; give at most 40",
        ),
        ('group = "lamps"\npositions', 'group = ""\npositions', ""),
        ("roughness = 0.4", 'group = "floor"', "materials.floor.group: 'floor' has no effect without emission"),
        ("scale = 5.0", 'scale = 5.0\ngroup = "floor"', "object[0].group: 'floor' has no effect without a file"),
    ],
)
def test_mistakes_are_told(folder, old, new, message, capsys):
    assert SCENE.count(old) == 1
    (folder / "lit.toml").write_text(SCENE.replace(old, new))
    code = render("--spp", 1, "--light-groups", "--out", "a.exr")
    error = capsys.readouterr().err
    assert (code == 2 and message in error and "Traceback" not in error) if message else code == 0


def test_a_scene_without_groups_is_told(folder, capsys):
    (folder / "lit.toml").write_text("\n".join(line for line in SCENE.splitlines() if not line.startswith("group")))
    assert render("--spp", 1, "--light-groups", "--out", "a.exr") == 2
    assert 'no light of lit has a group; give a light or a material one, as in group = "lamps"' in capsys.readouterr().err
    assert not Path("a.exr").exists()
    assert render("--spp", 1, "--mode", "area-restir", "--light-groups", "--out", "a.exr") == 2
    assert "error: --light-groups: area-restir reuses samples of the whole frame" in capsys.readouterr().err
