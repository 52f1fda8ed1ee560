"""`bokehguide metrics`."""

import numpy as np
import pytest

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
    return {label.strip(): [float(value) for value in values] for label, *values in lines}


def test_frame_and_insets(bokehguide, images):
    finished = bokehguide("metrics", *images, "--inset", "0,0,0.5,1", "--inset", "0.5,0,0.5,1")
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.split()[:4] == ["MAPE", "relMSE", "SSIM", "PSNR"]
    table = rows(finished.stdout)
    assert list(table) == ["frame", "inset 0,0,0.5,1", "inset 0.5,0,0.5,1"]
    assert table["frame"][:2] == [0.25, 0.125]
    assert table["inset 0,0,0.5,1"][:2] == [0.5, 0.25]
    assert table["inset 0.5,0,0.5,1"] == [0.0, 0.0, 1.0, float("inf")]


def test_mistakes_are_one_line(bokehguide, images, tmp_path):
    write_exr(tmp_path / "small.exr", {"beauty": np.ones((10, 40, 3), np.float32)})
    write_exr(tmp_path / "bad.exr", {"beauty": np.full((20, 40, 3), np.nan, np.float32)})
    cases = {
        ("metrics", "none.exr", "reference.exr"): "none.exr: cannot be read (No such file or directory); check the path",
        ("metrics", "small.exr", "reference.exr"): "small.exr against reference.exr: the image is 40x10 and",
        ("metrics", "bad.exr", "reference.exr"): "bad.exr against reference.exr: the image has 2400 NaN or infinite",
        ("metrics", *images, "--inset", "0.5,0,0.6,1"): "argument --inset: '0.5,0,0.6,1' leaves the frame",
        ("metrics", *images, "--inset", "-.5,0,.6,1"): "argument --inset: '-.5,0,.6,1' leaves the frame",
        ("metrics", *images, "--inset", "0,0,1"): "argument --inset: '0,0,1' is not X,Y,W,H",
        ("metrics", *images, "--inset", "0,0,0.1,1"): "4x20 pixels are too few for SSIM",
    }
    for arguments, message in cases.items():
        finished = bokehguide(*arguments)
        assert finished.returncode == 2, arguments
        assert finished.stdout == ""
        assert finished.stderr.startswith("bokehguide: error: "), finished.stderr
        assert message in finished.stderr
        assert finished.stderr.count("\n") == 1
