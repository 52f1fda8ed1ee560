"""Mistakes of the user: one clear line, exit code 2, and nothing rendered or written."""

import numpy as np
import pytest

from bokehguide.cli import main
from bokehguide.image import write_exr

MISTAKES = {
    "--mode lis-x": ["lis-x", "uniform", "lis-b", "lis-o"],
    "--spp 0": ["--spp", "'0'", "from 1 to"],
    "--spp -4": ["--spp", "'-4'"],
    "--spp many": ["--spp", "'many'"],
    "--threads 0": ["--threads", "'0'", "from 1 to"],
    "--seed -1": ["--seed", "'-1'", "from 0 to 2147483647"],
    "--seed 2147483648": ["--seed", "'2147483648'", "from 0 to 2147483647"],
    "--seed 1.5": ["--seed", "'1.5'"],
    "--size 0x20": ["--size", "'0x20'", "640x360"],
    "--size -3x20": ["--size", "'-3x20'", "640x360"],
    "--size 20": ["--size", "'20'", "640x360"],
    "--size 20x": ["--size", "'20x'", "640x360"],
    "--exposure nan": ["--exposure", "'nan'", "finite"],
    "--camera-position 1,2": ["--camera-position", "'1,2'", "X,Y,Z"],
    "--camera-position 1,2,x": ["--camera-position", "'1,2,x'", "X,Y,Z"],
    "--camera-target -inf,2,3": ["--camera-target"],
    "--camera-position 0,0,4 --camera-target 0,0,4": ["target"],
    "--focus-distance -2": ["focus", "-2"],
    "--focus-distance 0": ["focus", "0"],
    "--fov 190": ["fov", "190", "180"],
    "--f-number 0": ["f-number", "0"],
    "--aperture-radius -1": ["aperture-radius", "-1"],
    "--f-number 2 --aperture-radius 1": ["--f-number", "--aperture-radius"],
    "--environment 1,2": ["--environment", "1,2"],
    "--environment none.hdr": ["none.hdr"],
    "--device tpu": ["--device", "'tpu'", "cpu", "cuda"],
    "--out a.png": ["--out", "a.png", ".exr"],
    "--out lamps.toml/a.exr": ["lamps.toml/a.exr", "cannot be written", "another folder"],
    "--out folder.exr": ["folder.exr", "is a folder"],
    "--json lamps.toml/a.json": ["lamps.toml/a.json", "cannot be written", "another folder"],
    "--logdir lamps.toml": ["lamps.toml", "cannot be written", "another folder"],
    "--reference none.exr": ["none.exr", "cannot be read"],
    "--reference lamps.toml": ["lamps.toml", "not an EXR"],
    "--reference small.exr": ["--reference small.exr", "32x20", "16x10"],
    "--reference nan.exr": ["--reference nan.exr", "NaN"],
    "--spp": ["--spp", "expected one argument"],
    "--sp 4": ["--sp"],
    "--bogus": ["--bogus"],
}


@pytest.mark.parametrize("options", MISTAKES)
def test_render_refuses(options, lamps_file, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_exr("small.exr", {"beauty": np.ones((10, 16, 3), np.float32)})
    write_exr("nan.exr", {"beauty": np.full((20, 32, 3), np.nan, np.float32)})
    (tmp_path / "folder.exr").mkdir()
    before = sorted(tmp_path.rglob("*"))
    assert main(["render", "lamps.toml", *options.split()]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("bokehguide: error: ")
    assert err.count("\n") <= 2
    for words in MISTAKES[options]:
        assert words in err, err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "COMMAND"),
        (["paint"], "'paint'"),
        (["render"], "SCENE"),
        (["render", "none.toml"], "none.toml"),
        (["render", "none.glb"], "none.glb"),
        (["render", "nowhere"], "nowhere"),
        (["info", "none.toml"], "none.toml"),
    ],
)
def test_other_mistakes(arguments, words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    out, err = capfd.readouterr()
    assert (out, err[:19]) == ("", "bokehguide: error: ")
    assert words in err
    assert not list(tmp_path.iterdir())


def test_cuda_is_asked_for_where_there_is_none(lamps_file, tmp_path, monkeypatch, bokehguide):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    finished = bokehguide("render", lamps_file, "--device", "cuda", "--spp", 1)
    assert finished.returncode == 2
    assert "cuda" in finished.stderr and "cpu" in finished.stderr
    assert finished.stderr.count("\n") <= 2
