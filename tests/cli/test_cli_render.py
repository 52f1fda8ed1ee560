"""`bokehguide render`: files, reports, repeatability, interruption."""

import json
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import bokehguide as package
from bokehguide.cli import main
from bokehguide.image import read_exr, read_metadata, read_rgb, write_exr

PHASES = {"tracing rays", "shading", "guiding", "learning", "output"}


def mean_level(path):
    with Image.open(path) as picture:
        return np.asarray(picture).mean()


def test_files_and_reports(bokehguide, lamps_file, tmp_path):
    reference = np.full((20, 32, 3), 0.1, np.float32)
    write_exr(tmp_path / "reference.exr", {"beauty": reference})
    finished = bokehguide(
        *("render", lamps_file, "--spp", 6, "--seed", 3, "--out", "deep/a.exr", "--json", "a.json"),
        *("--reference", "reference.exr", "--logdir", "logs"),
    )
    assert finished.returncode == 0, finished.stderr
    assert "wrote deep/a.exr and deep/a.png" in finished.stdout
    assert "bokehguide: created the folder deep\n" in finished.stderr
    assert "6/6" in finished.stderr and "samples/s" in finished.stderr and "MAPE" in finished.stderr

    channels = read_exr(tmp_path / "deep/a.exr")
    assert {"R", "G", "B", "A", "depth.Z", "normal.X", "albedo.G", "variance.Y", "samples.Y"} <= channels.keys()
    assert all(plane.shape == (20, 32) for plane in channels.values())
    assert (channels["samples.Y"] == 6).all()
    header = read_metadata(tmp_path / "deep/a.exr")
    facts = {"scene": "emitters", "mode": "guided", "spp": 6, "seed": 3, "size": "32x20"}
    assert {name: header[name] for name in facts} == facts
    assert header["software"] == f"bokehguide {package.__version__}"
    assert json.loads(header["settings"])["camera"]["aperture_radius"] == 0.5
    with Image.open(tmp_path / "deep/a.png") as picture:
        assert picture.size == (32, 20)

    report = json.loads((tmp_path / "a.json").read_text())
    assert (report["mode"], report["spp"]) == ("guided", 6)
    radiance = read_rgb(tmp_path / "deep/a.exr")
    assert report["mape"] == pytest.approx(np.mean(np.abs(radiance - 0.1) / 0.11), rel=1e-5)
    assert report["relmse"] == pytest.approx(np.mean(((radiance - 0.1) / 0.11) ** 2), rel=1e-5)
    assert report["samples_per_second"] == pytest.approx(6 * 640 / report["seconds"])
    assert report["peak_memory_mb"] > 50
    assert report["gaussians"] >= 0
    assert report["phases"].keys() == PHASES
    assert sum(report["phases"].values()) == pytest.approx(report["seconds"], rel=0.02)
    assert len(list((tmp_path / "logs/emitters/guided").iterdir())) == 1


def test_json_goes_to_stdout_alone(bokehguide, lamps_file, tmp_path):
    finished = bokehguide("render", lamps_file, "--spp", 2, "--exposure", 1.5, "--json", "-")
    assert finished.returncode == 0, finished.stderr
    report = json.loads(finished.stdout)
    assert (report["spp"], report["exposure"]) == (2, 1.5)
    assert (report["exr"], report["png"]) == ("emitters-guided.exr", "emitters-guided.png")
    assert "2 SPP in " in finished.stderr and "wrote emitters-guided.exr and emitters-guided.png" in finished.stderr
    names = {"emitters.toml", "emitters-guided.exr", "emitters-guided.png"}
    assert {path.name for path in tmp_path.iterdir()} == names
    refused = bokehguide("render", lamps_file, "--spp", 0, "--json", "-")
    assert refused.returncode == 2 and refused.stdout == ""


@pytest.mark.slow
def test_the_command_in_the_header_renders_the_same_bits(bokehguide, lamps_file, tmp_path):
    options = ("--mode", "lis", "--spp", 3, "--camera-position", "-0.5,0.1,4", "--size", "24x16", "--f-number", 90.5)
    first = bokehguide("render", lamps_file, *options, "--environment", ".1,.2,.3", "--out", "a.exr")
    assert first.returncode == 0, first.stderr
    command = shlex.split(read_metadata(tmp_path / "a.exr")["command"])
    assert command[:3] == ["bokehguide", "render", str(lamps_file)]
    again = bokehguide(*command[1:], "--out", "b.exr", "--threads", 3)
    assert again.returncode == 0, again.stderr
    one, two = read_exr(tmp_path / "a.exr"), read_exr(tmp_path / "b.exr")
    assert one["R"].shape == (16, 24)
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


def test_without_options_the_file_is_named_after_scene_and_mode(lamps_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["render", "emitters.toml", "--spp", "1", "--mode", "uniform", "--json", "a.json"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        *("emitters.toml", "a.json", "emitters-uniform.exr", "emitters-uniform.png")
    }
    report = json.loads((tmp_path / "a.json").read_text())
    assert "mape" not in report and report["phases"].keys() == PHASES


def test_exposure_is_of_the_png_only(lamps_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, exposure in (("a", "0"), ("b", "-3")):
        options = ["--spp", "1", "--exposure", exposure, "--out", f"{name}.exr"]
        assert main(["render", "emitters.toml", *options]) == 0
    np.testing.assert_array_equal(read_rgb("a.exr"), read_rgb("b.exr"))
    assert 0.0 < mean_level("b.png") < 0.6 * mean_level("a.png")


@pytest.mark.slow
def test_an_interrupted_render_writes_what_is_there(lamps_file, tmp_path):
    command = [sys.executable, "-m", "bokehguide", "render", str(lamps_file), "--spp", "1000000", "--mode", "uniform"]
    command += ["--out", "a.exr", "--json", "a.json"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        stderr = ""
        while "/1000000" not in stderr and process.poll() is None:  # the progress bar, when rendering begins
            stderr += process.stderr.read(1)
        process.send_signal(signal.SIGINT)
        stderr += process.communicate(timeout=60)[1]
    assert process.returncode == 130, stderr
    spp = json.loads((tmp_path / "a.json").read_text())["spp"]
    assert 1 <= spp < 1000000
    assert f"bokehguide: interrupted at {spp} of 1000000 SPP" in stderr
    assert "Traceback" not in stderr
    assert (read_exr(tmp_path / "a.exr")["samples.Y"] == spp).all()
    assert read_metadata(tmp_path / "a.exr")["spp"] == spp
    assert (tmp_path / "a.png").exists()
