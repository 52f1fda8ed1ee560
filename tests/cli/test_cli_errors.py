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
    "--max-depth 0": ["--max-depth", "'0'", "from 1 to 65536"],
    "--max-depth 65537": ["--max-depth", "'65537'", "from 1 to 65536"],
    "--seed -1": ["--seed", "'-1'", "from 0 to 2147483647"],
    "--seed 2147483648": ["--seed", "'2147483648'", "from 0 to 2147483647"],
    "--seed 1.5": ["--seed", "'1.5'"],
    "--size 0x20": ["--size", "'0x20'", "640x360"],
    "--size -3x20": ["--size", "'-3x20'", "640x360"],
    "--size 20": ["--size", "'20'", "640x360"],
    "--size 20x": ["--size", "'20x'", "640x360"],
    "--size 1000000x1000000": ["--size", "'1000000'", "from 1 to 65536"],
    "--size 65536x65536": ["--size", "'65536x65536'", "at most 268435456"],
    "--threads 1025": ["--threads", "'1025'", "from 1 to 1024"],
    "--exposure nan": ["--exposure", "'nan'", "finite"],
    "--exposure bright": ["--exposure", "'bright' is not EV; give a finite number from -100 to 100, or auto; see"],
    "--exposure -100.5": ["--exposure", "'-100.5'", "from -100 to 100"],
    "--exposure 1e9": ["--exposure", "'1e9'", "from -100 to 100"],
    f"--spp {'9' * 5000}": ["--spp", "from 1 to 2147483647"],
    "--camera-position 1e39,0,0": ["--camera-position", "'1e39,0,0'", "1e+18"],
    "--focus-distance 1e39": ["--focus-distance", "1e+39", "out of range"],
    "--f-number 1e-320": ["--f-number", "1e-320", "out of range"],
    "--f-number 1e-18 --fov 0.001": ["f_number", "larger"],
    "--fov wide": ["argument --fov: 'wide' is not a number; give one, such as 0.5; see"],
    "--target-noise low": ["argument --target-noise: 'low' is not a number; give one, such as 0.5"],
    "--target-noise 5": ["error: --target-noise: 5.0 is out of range; give a relative error from 1e-06 to 1"],
    "--crop 31,19,2,1": ["error: --crop: 31,19,2,1 leaves the frame"],
    "--mode area-restir --light-groups": ["error: --light-groups: area-restir reuses samples of the whole frame"],
    "--aperture-radius 1e30": ["--aperture-radius", "1e+30", "out of range"],
    "--fov 1e-30": ["--fov", "1e-30", "0.001"],
    "--environment 1e39,1,1": ["--environment", "1e39,1,1", "1e+18"],
    "--environment cut.exr": ["cut.exr: is damaged"],
    "--camera-position 1,2": ["--camera-position", "'1,2'", "X,Y,Z"],
    "--camera-position 1,2,x": ["--camera-position", "'1,2,x'", "X,Y,Z"],
    "--camera-target -inf,2,3": ["--camera-target", "'-inf,2,3' is not X,Y,Z"],
    "--camera-position 0,0,4 --camera-target 0,0,4": ["target"],
    "--focus-distance -2": ["focus", "-2"],
    "--focus-distance 0": ["focus", "0"],
    "--focus-distance -inf": ["--focus-distance: -inf is out of range"],
    "--focus-distance nan": ["--focus-distance: nan is out of range"],
    "--focus-distance -NaN": ["--focus-distance: nan is out of range"],
    "--fov -Infinity": ["--fov: -inf is out of range"],
    "--fov 190": ["fov", "190", "180"],
    "--f-number 0": ["f-number", "0"],
    "--aperture-radius -1": ["aperture-radius", "-1"],
    "--f-number 2 --aperture-radius 1": ["--f-number", "--aperture-radius"],
    "--environment 1,2": ["--environment", "1,2"],
    "--environment none.hdr": ["none.hdr"],
    "--environment red": ["--environment: 'red' is neither three numbers R,G,B nor a .hdr or .exr map; give one of them"],
    "--device tpu": ["--device", "'tpu'", "cpu", "cuda"],
    "--out a.png": ["--out", "a.png", ".exr"],
    "--out emitters.toml/a.exr": ["emitters.toml/a.exr", "cannot be written", "another folder"],
    "--out folder.exr": ["folder.exr", "is a folder"],
    "--out shown.exr": ["shown.png", "is a folder"],
    "--out good.exr --reference good.exr": ["--reference", "good.exr", "another path"],
    "--out a.exr --json a.exr": ["--json", "a.exr", "another path"],
    "--out good.exr --reference ./folder.exr/../good.exr": ["--reference", "another path"],
    "--out a.exr --json ./a.png": ["--json", "a.png", "another path"],
    "--reference good.exr --json good.exr": ["--json", "good.exr", "another path"],
    "--json good.exr": ["--json", "'good.exr'", "picture or a checkpoint", "another path"],
    "--json good.PNG": ["--json", "'good.PNG'", "another path"],
    "--json a.ckpt": ["--json", "'a.ckpt'", "another path"],
    "--json emitters.toml/a.json": ["emitters.toml/a.json", "cannot be written", "another folder"],
    "--logdir emitters.toml": ["emitters.toml", "cannot be written", "another folder"],
    "--reference none.exr": ["none.exr", "cannot be read"],
    "--reference emitters.toml": ["emitters.toml", "not an EXR"],
    "--reference cut.exr": ["cut.exr: is damaged"],
    "--reference small.exr": ["small.exr: ", "32x20", "16x10"],
    "--reference nan.exr": ["nan.exr: ", "NaN"],
    "--spp": ["--spp", "expected one argument"],
    "--sp 4": ["--sp"],
    "--reuse-radius 50": ["--reuse-radius: 50 has no effect in guided; leave it out, or choose area-restir or area-restir+lis"],
    "--bogus": ["unrecognized option --bogus; the nearest of ", " known are --"],
    "--sppp 8": ["unrecognized option --sppp; did you mean '--spp'? See `bokehguide render --help`"],
    "-spp 8": ["unrecognized option -spp; did you mean '--spp'?"],
    "--apertur-radius=8": ["unrecognized option --apertur-radius; did you mean '--aperture-radius'?"],
    "--mode guidd": ["'guidd'; did you mean 'guided'? Known are uniform, lis, ", "area-restir+lis; see"],
    "--mode xyz": ["'xyz'; known are uniform, lis, "],
}


@pytest.mark.parametrize("options", MISTAKES, ids=lambda options: options[:50])
def test_render_refuses(options, lamps_file, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_exr("small.exr", {"beauty": np.ones((10, 16, 3), np.float32)})
    write_exr("nan.exr", {"beauty": np.full((20, 32, 3), np.nan, np.float32)})
    write_exr("good.exr", {"beauty": np.ones((20, 32, 3), np.float32)})
    (tmp_path / "cut.exr").write_bytes((tmp_path / "good.exr").read_bytes()[:-20])
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "shown.png").mkdir()
    before = sorted(tmp_path.rglob("*"))
    assert main(["render", "emitters.toml", *options.split()]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("bokehguide: error: ")
    assert err.count("\n") == 1
    for words in MISTAKES[options]:
        assert words in err, err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "COMMAND"),
        (["paint"], "'paint'"),
        (["rendr", "cutout", "--spp", "8"], "'rendr'; did you mean 'render'? Known are render, view, "),
        (["--versoin"], "unrecognized option --versoin; did you mean '--version'?"),
        (["compare", "cutout", "--ot", "x"], "unrecognized option --ot; did you mean '--out'?"),
        (["compare", "cutout", "--out", "x", "--modes", "guided,lsi"], "'lsi'; did you mean 'lis'?"),
        (["render", "--", "--sppp"], "--sppp: no such scene"),
        (["info", "--focus-on", "a --spp lamp", "none.toml"], "none.toml: "),
        (["render"], "SCENE"),
        (["render", "none.toml"], "none.toml"),
        (["render", "none.glb"], "none.glb"),
        (["render", "nowhere"], "nowhere"),
        (
            ["compare", "cutout", "--modes", "uniform", "guided", "--out", "x"],
            "unrecognized argument guided; an option takes one word, with commas in lists; see `bokehguide compare --help`",
        ),
        (["render", "cutout", "--time-limit", "5m"], "argument --time-limit: '5m' is not SECONDS; give a finite number"),
        (["render", "my a.exr"], "my a.exr: is a picture, and no scene; `bokehguide develop 'my a.exr'` makes a PNG of it"),
        (["info", "a.EXR"], "a.EXR: is a picture, and no scene; `bokehguide develop a.EXR` makes a PNG of it"),
        (["render", "a.hdr"], "a.hdr: is an environment map, and no scene; give a scene or a model, with --environment a.hdr"),
        (["render", "a.step"], "a.step: a .step file; convert it to a mesh, with FreeCAD for example, and give the .stl"),
        (["render", "a.3ds"], "a.3ds: a .3ds file; convert it to glTF, with Blender for example, and give the .glb"),
        (["render", "a.ckpt"], "a.ckpt: is a checkpoint, and no scene; give the scene of its render, with --out a.exr --resume"),
        (["info", "none.toml"], "none.toml"),
        (["info", "cutout", "--json", "a.png"], "argument --json: 'a.png' is the name of a picture or a checkpoint"),
    ],
)
def test_other_mistakes(words, told, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    out, err = capfd.readouterr()
    assert (out, err[:19]) == ("", "bokehguide: error: ")
    assert told in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.txt", "folder"])
def test_a_file_that_is_no_scene_is_told_to_exist(name, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.txt").write_text("text")
    (tmp_path / "folder").mkdir()
    assert main(["render", name]) == 2
    assert f"error: {name}: exists, and is no scene of a known kind\nGive a built-in name (" in capfd.readouterr().err


@pytest.mark.slow
def test_cuda_is_asked_for_where_there_is_none(lamps_file, tmp_path, monkeypatch, bokehguide):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    finished = bokehguide("render", lamps_file, "--device", "cuda", "--spp", 1)
    assert finished.returncode == 2
    assert "cuda" in finished.stderr and "cpu" in finished.stderr
    assert finished.stderr.count("error") == 1
