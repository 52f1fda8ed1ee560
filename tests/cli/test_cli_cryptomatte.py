"""`bokehguide render --cryptomatte`: files that compositors read, resumed and denoised renders, and mistakes."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import trimesh

from bokehguide.cli import main
from bokehguide.image import read_exr, read_metadata
from tests.support.paths import ASSETS
from tests.support.same_bits import assert_same_layers

pytest.importorskip("mmh3")
cryptomatte_api = pytest.importorskip("cryptomatte_api")


def masks(path: Path | str, layer: str = "CryptoObject") -> dict[str, np.ndarray]:
    """The mattes of a layer by name, `[H, W]`, as the decoder finds them in a file."""
    (matte,) = (each for each in cryptomatte_api.Cryptomatte.load(str(path)) if each.metadata().name() == layer)
    return {name: mask.reshape(matte.height(), matte.width()) for name, mask in matte.masks().items()}


def render(*options: object) -> int:
    return main(["render", "emitters.toml", "--threads", "1", *map(str, options)])


@pytest.mark.parametrize("mode", ["uniform", "guided"])
def test_a_decoder_finds_the_objects_and_materials(lamps_folder, mode):
    assert render("--mode", mode, "--spp", 16, "--cryptomatte", "--out", "a.exr") == 0
    hit = read_exr("a.exr")["depth.Z"] < 1e9
    for layer, names in (("CryptoObject", {"object[0]", "object[1]"}), ("CryptoMaterial", {"wall", "emitter"})):
        found = masks("a.exr", layer)
        assert found.keys() == names
        total = sum(found.values())
        assert total.shape == hit.shape and 0.05 < total.mean() < 0.9
        np.testing.assert_array_equal(total[~hit], 0.0)
        assert all(0.0 < mask.max() <= 1.0 for mask in found.values())
        assert ((total > 0.1) & (total < 0.9)).sum() > 20  # the box is out of focus at its edges


def test_openimageio_reads_the_layers(lamps_folder):
    assert render("--spp", 2, "--cryptomatte", "--out", "a.exr") == 0
    image = oiio.ImageBuf("a.exr")
    spec = image.spec()
    assert image.nsubimages == 1 and image.get_pixels().shape == (20, 32, len(spec.channelnames))
    for layer in ("CryptoObject", "CryptoMaterial"):
        assert {f"{layer}0{number}.{channel}" for number in range(3) for channel in "RGBA"} <= set(spec.channelnames)
    assert sum(attribute.name.startswith("cryptomatte/") for attribute in spec.extra_attribs) == 8


def test_other_layers_are_unchanged_and_the_command_is_kept(lamps_folder):
    assert render("--spp", 3, "--out", "plain.exr") == 0 and render("--spp", 3, "--cryptomatte", "--out", "a.exr") == 0
    plain, found = read_exr("plain.exr"), read_exr("a.exr")
    assert all(name.startswith("Crypto") for name in found.keys() - plain.keys())
    assert_same_layers(found, plain)
    command = shlex.split(read_metadata("a.exr")["command"])
    assert command[3:].count("--cryptomatte") == 1 and "--cryptomatte" not in read_metadata("plain.exr")["command"]
    assert main([*command[1:], "--threads", "1", "--out", "b.exr"]) == 0
    assert_same_layers(found, read_exr("b.exr"))


@pytest.mark.parametrize("options", [("--mode", "guided"), ("--mode", "lis-o", "--target-noise", 0.3, "--crop", "4,3,20,15")])
def test_a_resumed_render_has_the_same_mattes(lamps_folder, options, capsys):
    options = (*options, "--cryptomatte")
    assert render(*options, "--spp", 20, "--out", "whole.exr") == 0
    assert render(*options, "--spp", 9, "--out", "part.exr", "--checkpoint-every", 100) == 0
    assert render("--mode", options[1], "--spp", 9, "--out", "part.exr", "--resume", *options[2:-1]) == 2  # without mattes
    assert "cryptomatte was True and is False" in capsys.readouterr().err
    assert render(*options, "--spp", 20, "--out", "part.exr", "--resume") == 0
    assert "resuming" in capsys.readouterr().err
    whole, part = read_exr("whole.exr"), read_exr("part.exr")
    assert_same_layers(part, whole)
    assert all(mask.max() > 0.0 for mask in masks("part.exr").values())


def test_named_copies_of_a_model_have_the_names_of_info(lamps_folder):
    trimesh.creation.icosphere().export("ball.ply")
    place = '[[object]]\nfile = "ball.ply"\nname = "{}"\nscale = 0.3\ntranslate = [{}, 0.5, 1.0]\n'
    with Path("emitters.toml").open("a") as file:
        file.write(place.format("left", -0.5) + place.format("right", 0.5))
    assert render("--spp", 4, "--cryptomatte", "--out", "a.exr") == 0 and main(["info", "emitters.toml", "--json", "a.json"]) == 0
    names = [entry["name"] for entry in json.loads(Path("a.json").read_text())["objects"]]
    assert names == ["object[0]", "object[1]", "left", "right"]
    found = masks("a.exr")
    assert found.keys() == set(names) and not (found["left"] * found["right"]).any()
    assert all(found[name].max() > 0.5 for name in ("left", "right"))


def test_a_model_has_the_mattes_of_its_nodes_and_materials(tmp_path, monkeypatch):
    model = ASSETS / "models" / "chess-board.glb"
    if not model.is_file():
        pytest.skip("the model is absent")
    monkeypatch.chdir(tmp_path)
    options = ("--size", "64x36", "--spp", "4", "--cryptomatte", "--out", "a.exr")
    assert main(["render", str(model), *options]) == 0
    for layer in ("CryptoObject", "CryptoMaterial"):
        found = masks("a.exr", layer)
        assert len(found) > 2
        np.testing.assert_array_less(sum(found.values()), 1.0 + 1e-5)


def test_a_missing_hash_is_told_before_the_render(lamps_folder, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mmh3", None)
    assert render("--cryptomatte") == 2
    error = capsys.readouterr().err
    assert "pip install 'bokehguide[cryptomatte]'" in error and len(error.splitlines()) == 1
