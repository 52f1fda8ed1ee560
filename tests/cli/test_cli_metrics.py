"""`bokehguide metrics`."""

import json

import numpy as np
import pytest

from bokehguide.cli import main
from bokehguide.image import write_exr


@pytest.fixture
def images(tmp_path):
    """An image and its reference, 40 × 20, that differ in the left half only: 1.5 and 0.99."""
    reference = np.full((20, 40, 3), 0.99, np.float32)
    image = reference.copy()
    image[:, :20] = 1.49
    write_exr(tmp_path / "image.exr", {"beauty": image})
    write_exr(tmp_path / "reference.exr", {"beauty": reference})
    return "image.exr", "reference.exr"


def rows(text):
    lines = [line.rsplit(maxsplit=4) for line in text.splitlines()[1:]]
    return {label.strip(): [value if value == "-" else float(value) for value in values] for label, *values in lines}


def test_frame_and_insets(bokehguide, images):
    finished = bokehguide("metrics", *images, "--inset", "0,0,0.5,1", "--inset", "0.5,0,0.5,1")
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.split()[:4] == ["MAPE", "relMSE", "SSIM", "PSNR"]
    table = rows(finished.stdout)
    assert list(table) == ["frame", "inset 0,0,0.5,1", "inset 0.5,0,0.5,1"]
    assert table["frame"][:2] == [0.25, 0.125]
    assert table["inset 0,0,0.5,1"][:2] == [0.5, 0.25]
    assert table["inset 0.5,0,0.5,1"] == [0.0, 0.0, 1.0, float("inf")]


def test_the_measures_as_json(bokehguide, images, tmp_path):
    command = ("metrics", *images, "--inset", "0,0,0.5,1", "--inset", "0.9,0,0.1,0.5", "--json")
    piped = bokehguide(*command, "-")
    assert piped.returncode == 0, piped.stderr
    found = json.loads(piped.stdout)
    assert list(found) == ["frame", "inset 0,0,0.5,1", "inset 0.9,0,0.1,0.5"]
    assert found["frame"].keys() == {"mape", "relmse", "ssim", "psnr"}
    assert found["frame"]["mape"] == pytest.approx(0.25) and found["inset 0,0,0.5,1"]["relmse"] == pytest.approx(0.25)
    assert found["inset 0.9,0,0.1,0.5"] == {"mape": 0.0, "relmse": 0.0, "ssim": None, "psnr": None}
    assert rows(piped.stderr)["frame"][:2] == [0.25, 0.125]
    written = bokehguide(*command, "made/a.json")
    assert json.loads((tmp_path / "made/a.json").read_text()) == found and list(rows(written.stdout)) == list(found)
    refused = bokehguide(*command, "image.exr")
    assert refused.returncode == 2 and "'image.exr' is the name of a picture" in refused.stderr


@pytest.mark.slow
def test_an_inset_too_small_for_ssim_has_a_dash_there(bokehguide, images):
    finished = bokehguide("metrics", *images, "--inset", "0,0,0.25,1", "--inset", "0.01,0.01,0.01,0.01")
    assert finished.returncode == 0, finished.stderr
    table = rows(finished.stdout)
    assert table["inset 0,0,0.25,1"] == [0.5, 0.25, "-", table["inset 0.01,0.01,0.01,0.01"][3]]
    assert isinstance(table["frame"][2], float)


@pytest.mark.slow
def test_a_reference_of_few_spp_is_clamped_with_a_warning(bokehguide, lamps_file):
    """The control variate of the first step leaves negative values."""
    size = ("--size", "160x90", "--seed", 1)
    assert bokehguide("render", "daylight", *size, "--spp", 1, "--out", "a.exr").returncode == 0
    told = "bokehguide: warning: a.exr: the reference has "
    finished = bokehguide("metrics", "a.exr", "a.exr")
    assert finished.returncode == 0 and "frame" in finished.stdout
    assert finished.stderr.startswith(told) and finished.stderr.count("\n") == 1, finished.stderr
    words = ("--spp", 1, "--reference", "a.exr", "--size", "160x90", "--out")
    for command in (("render", "daylight", *words, "b.exr"), ("compare", "daylight", *words, "c", "--modes", "uniform")):
        finished = bokehguide(*command)
        assert finished.returncode == 0 and finished.stderr.count(told) == 1, finished.stderr


MISTAKES = {
    "none.exr reference.exr": "none.exr: cannot be read (No such file or directory); check the path",
    "cut.exr reference.exr": "cut.exr: is damaged",
    "image.exr none.exr": "none.exr: cannot be read (No such file or directory); check the path",
    "image.exr cut.exr": "cut.exr: is damaged",
    "small.exr reference.exr": "small.exr against reference.exr: the image is 40x10 and",
    "crop.exr other.exr": "crop 8,4,40,20 of 64x48 pixels, and the reference is the crop 9,4,40,20 of 64x48",
    "crop.exr larger.exr": "crop 8,4,40,20 of 64x48 pixels, and the reference is the crop 8,4,40,20 of 128x96",
    "crop.exr cut_crop.exr": "crop 8,4,40,20 of 64x48 pixels, and the reference is the crop 8,4,40,10 of 64x48",
    "bad.exr reference.exr": "bad.exr against reference.exr: the image has 2400 NaN or infinite",
    "image.exr reference.exr --inset 0.5,0,0.6,1": "argument --inset: '0.5,0,0.6,1' leaves the frame",
    "image.exr reference.exr --inset -.5,0,.6,1": "argument --inset: '-.5,0,.6,1' leaves the frame",
    "image.exr reference.exr --inset 0,0,1": "argument --inset: '0,0,1' is not X,Y,W,H",
    "image.exr": "REFERENCE.exr",
}


def write_crop(name, corner, frame, height=20):
    write_exr(name, {"beauty": np.ones((height, 40, 3), np.float32)}, corner=corner, frame=frame)


@pytest.mark.slow
def test_equal_crops_are_compared_and_a_whole_frame_may_stand_for_a_crop(images, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_crop("crop.exr", (8, 4), (64, 48))
    for reference in ("crop.exr", "reference.exr"):
        assert main(["metrics", "crop.exr", reference]) == 0, capfd.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("arguments", MISTAKES)
def test_mistakes_are_one_line(arguments, images, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_exr("small.exr", {"beauty": np.ones((10, 40, 3), np.float32)})
    (tmp_path / "cut.exr").write_bytes((tmp_path / "image.exr").read_bytes()[:-20])
    write_crop("crop.exr", (8, 4), (64, 48))
    write_crop("other.exr", (9, 4), (64, 48))
    write_crop("larger.exr", (8, 4), (128, 96))
    write_crop("cut_crop.exr", (8, 4), (64, 48), height=10)
    write_exr("bad.exr", {"beauty": np.full((20, 40, 3), np.nan, np.float32)})
    assert main(["metrics", *arguments.split()]) == 2
    out, err = capfd.readouterr()
    assert (out, err[:19], err.count("\n")) == ("", "bokehguide: error: ", 1)
    assert MISTAKES[arguments] in err
