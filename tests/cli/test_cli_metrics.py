"""`bokehguide metrics`."""

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


@pytest.mark.slow
def test_an_inset_too_small_for_ssim_has_a_dash_there(bokehguide, images):
    finished = bokehguide("metrics", *images, "--inset", "0,0,0.25,1", "--inset", "0.01,0.01,0.01,0.01")
    assert finished.returncode == 0, finished.stderr
    table = rows(finished.stdout)
    assert table["inset 0,0,0.25,1"] == [0.5, 0.25, "-", table["inset 0.01,0.01,0.01,0.01"][3]]
    assert isinstance(table["frame"][2], float)


MISTAKES = {
    "none.exr reference.exr": "none.exr: cannot be read (No such file or directory); check the path",
    "cut.exr reference.exr": "cut.exr: is damaged",
    "small.exr reference.exr": "small.exr against reference.exr: the image is 40x10 and",
    "bad.exr reference.exr": "bad.exr against reference.exr: the image has 2400 NaN or infinite",
    "image.exr reference.exr --inset 0.5,0,0.6,1": "argument --inset: '0.5,0,0.6,1' leaves the frame",
    "image.exr reference.exr --inset -.5,0,.6,1": "argument --inset: '-.5,0,.6,1' leaves the frame",
    "image.exr reference.exr --inset 0,0,1": "argument --inset: '0,0,1' is not X,Y,W,H",
    "image.exr": "REFERENCE.exr",
}


@pytest.mark.slow
@pytest.mark.parametrize("arguments", MISTAKES)
def test_mistakes_are_one_line(arguments, images, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_exr("small.exr", {"beauty": np.ones((10, 40, 3), np.float32)})
    (tmp_path / "cut.exr").write_bytes((tmp_path / "image.exr").read_bytes()[:-20])
    write_exr("bad.exr", {"beauty": np.full((20, 40, 3), np.nan, np.float32)})
    assert main(["metrics", *arguments.split()]) == 2
    out, err = capfd.readouterr()
    assert (out, err[:19], err.count("\n")) == ("", "bokehguide: error: ", 1)
    assert MISTAKES[arguments] in err
