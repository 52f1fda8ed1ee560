"""Parts of a frame and ends before the last SPP: `--crop`, `--time-limit`, `--target-noise`."""

import json
import math
import shlex

import numpy as np
import OpenEXR
import pytest

from bokehguide.cli.arguments import parse
from bokehguide.image import read_exr, read_metadata, write_exr
from bokehguide.render.vector import luminance
from bokehguide.scene import load_scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.train.settings import crop_pixels
from tests.support import scenes
from tests.support.statistical import SIGNIFICANCE, z_test


@pytest.mark.parametrize(
    "crop, box",
    [
        ("5,5,1,1", (5, 5, 1, 1)),
        ("0,2,1,1", (0, 2, 1, 1)),
        ("-1,0,1,1", (-1, 0, 1, 1)),
        ("0,0,1,1", (0, 0, 32, 20)),
        ("0,0,1,0.5", (0, 0, 32, 10)),
    ],
)
def test_a_crop_is_in_fractions_if_all_values_are(crop, box):
    options = parse(["render", "cutout", "--crop", crop])
    assert crop_pixels(options.crop, 32, 20) == box


@pytest.mark.slow
@pytest.mark.parametrize(
    "crop, box",
    [("5,3,21,13", (5, 3, 21, 13)), ("0.25,0.5,0.5,0.25", (8, 10, 16, 5)), ("5,5,1,1", (5, 5, 1, 1)), ("31,19,2,1", None)],
)
def test_a_crop_has_the_bits_of_the_frame(crop, box, bokehguide, lamps_file, tmp_path):
    options = ("render", lamps_file, "--mode", "uniform", "--spp", 5)
    finished = bokehguide(*options, "--crop", crop, "--out", "part.exr")
    if box is None:
        assert (
            finished.returncode == 2
            and "error: --crop: 31,19,2,1 leaves the frame; give X,Y,W,H within its 32 x 20 pixels" in finished.stderr
        )
        return
    assert finished.returncode == 0, finished.stderr
    assert bokehguide(*options, "--out", "whole.exr").returncode == 0
    left, top, width, height = box
    whole, part = read_exr(tmp_path / "whole.exr"), read_exr(tmp_path / "part.exr")
    for name, plane in whole.items():
        np.testing.assert_array_equal(part[name], plane[top : top + height, left : left + width], err_msg=name)
    header = OpenEXR.File(str(tmp_path / "part.exr")).header()
    first, last = (corner.tolist() for corner in header["dataWindow"])
    assert first == [left, top] and last == [left + width - 1, top + height - 1]
    assert header["displayWindow"][1].tolist() == [31, 19]
    again = bokehguide(*shlex.split(read_metadata(tmp_path / "part.exr")["command"])[1:], "--out", "again.exr")
    assert again.returncode == 0
    np.testing.assert_array_equal(read_exr(tmp_path / "again.exr")["R"], part["R"])


@pytest.mark.slow
@pytest.mark.parametrize("crop", [(0, 0, 1, 1), (7, 5, 61, 3), (90, 50, 6, 4), (1, 1, 94, 52)])
def test_no_bit_depends_on_the_batch(crop):
    """A scene with an environment map, emitters, glass and paths of six segments."""
    scene = load_scene("night-street")
    scene = type(scene)(**(vars(scene) | {"film": type(scene.film)(96, 54, 6)}))
    loops = [RenderLoop(scene, RenderSettings("uniform", threads=1, crop=box)) for box in (None, crop)]
    for loop in loops:
        for _ in range(3):
            loop.step()
    x, y, width, height = crop
    whole, part = (loop.film.layers() for loop in loops)
    for name, layer in part.items():
        np.testing.assert_array_equal(layer, whole[name][y : y + height, x : x + width], err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lis-o", "guided"])
def test_a_guided_crop_has_the_mean_of_the_frame(mode):
    scene, crop = scenes.emitters(64, 40), (20, 8, 30, 25)
    means, errors = [], []
    for box, spp in ((None, 256), (crop, 512)):
        loop = RenderLoop(scene, RenderSettings(mode, seed=4, threads=1, crop=box))
        for _ in range(spp):
            loop.step()
        rows, columns = (slice(8, 33), slice(20, 50)) if box is None else (slice(None), slice(None))
        light = luminance(loop.film.radiance().double().permute(2, 0, 1))[rows, columns]
        means.append(float(light.mean()))
        errors.append(math.sqrt(float(loop.film.variance().double()[rows, columns].mean()) / light.numel()))
    assert z_test(means[0] - means[1], math.hypot(*errors)) > SIGNIFICANCE


@pytest.mark.slow
def test_the_error_of_a_crop_is_measured_against_the_frame(bokehguide, lamps_file, tmp_path):
    reference = np.random.default_rng(1).random((20, 32, 3)).astype(np.float32)
    write_exr(tmp_path / "reference.exr", {"beauty": reference})
    options = ("--crop", "4,6,10,9", "--reference", "reference.exr", "--json", "a.json", "--logdir", "logs", "--out", "a.exr")
    finished = bokehguide("render", lamps_file, "--spp", 2, *options)
    assert finished.returncode == 0, finished.stderr
    part = np.stack([read_exr(tmp_path / "a.exr")[name] for name in "RGB"], axis=-1)
    expected = reference[6:15, 4:14]
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["mape"] == pytest.approx(np.mean(np.abs(part - expected) / (expected + 0.01)), rel=1e-5)
    assert report["samples"] == 2 * 90


@pytest.mark.slow
def test_a_time_limit_ends_a_render_and_all_its_sessions(bokehguide, lamps_file, tmp_path):
    options = ("render", lamps_file, "--spp", 100000, "--out", "a.exr", "--json", "a.json", "--checkpoint-every", 60)
    finished = bokehguide(*options, "--time-limit", 15)  # loading counts
    assert finished.returncode == 0, finished.stderr
    assert "stopped: another step would exceed --time-limit 15" in finished.stdout
    first = json.loads((tmp_path / "a.json").read_text())
    assert 1 < first["spp"] < 100000
    assert (read_exr(tmp_path / "a.exr")["samples.Y"] == first["spp"]).all()
    resumed = bokehguide(*options, "--time-limit", 0.1, "--resume")
    assert resumed.returncode == 0
    assert json.loads((tmp_path / "a.json").read_text())["spp"] == first["spp"] + 1, "a session takes a step at least"


@pytest.mark.slow
def test_a_target_ends_a_render(bokehguide, lamps_file, tmp_path):
    options = (
        "render",
        lamps_file,
        "--spp",
        4096,
        "--target-noise",
        0.3,
        "--out",
        "a.exr",
        "--json",
        "a.json",
        "--checkpoint-every",
        60,
    )
    finished = bokehguide(*options, "--logdir", "logs")
    assert finished.returncode == 0, finished.stderr
    assert "stopped: every block has reached --target-noise 0.3" in finished.stdout and "estimated MAPE" in finished.stdout
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["spp"] < 4096 and report["estimated_mape"] < 0.3
    counts = read_exr(tmp_path / "a.exr")["samples.Y"]
    assert report["samples"] == counts.sum()
    again = bokehguide(*options, "--resume")
    assert again.returncode == 0 and f"resuming a.ckpt at {report['spp']} SPP" in again.stderr
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["samples.Y"], counts)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options, message",
    [
        (("--crop", "1,2,3"), "argument --crop: '1,2,3' is not X,Y,W,H"),
        (("--crop", "1.5,2,3,4"), "argument --crop: '1.5,2,3,4' is in pixels and not whole"),
        (("--crop", "0.5,0.5,0.6,0.5"), "argument --crop: '0.5,0.5,0.6,0.5' leaves the frame"),
        (("--crop", "-1,0,5,5"), "error: --crop: -1,0,5,5 leaves the frame"),
        (("--crop", "1,1,5,5", "--mode", "area-restir"), "error: --crop: area-restir reuses samples of the whole frame"),
        (("--time-limit", "0"), "argument --time-limit: '0' is not positive"),
        (("--target-noise", "-1"), "error: --target-noise: -1.0 is out of range; give a relative error from 1e-06 to 1"),
        (("--target-noise", "nan"), "error: --target-noise: nan is out of range"),
    ],
)
def test_mistakes_are_told_in_a_line(options, message, bokehguide, lamps_file):
    finished = bokehguide("render", lamps_file, *options)
    *stages, error = finished.stderr.splitlines()
    assert finished.returncode == 2 and message in error
    assert all(stage.startswith("bokehguide: ") and "error" not in stage for stage in stages)
