"""The scripts beside the package: their mistakes are told before the first ray, and what they write."""

import importlib.util
import json
import os
import subprocess
import sys
import tomllib

import numpy as np
import pytest
import torch

from bokehguide.cli.scripts import run
from bokehguide.errors import BokehguideError
from bokehguide.image import read_metadata, read_rgb, write_exr
from bokehguide.runtime import native
from bokehguide.train import MODES
from tests.support.paths import ASSETS, REPOSITORY

SCRIPTS = REPOSITORY / "scripts"


def test_every_mutation_of_the_list_is_possible():
    """`mutate.py` replaces a text that occurs once."""
    listed = tomllib.loads((SCRIPTS / "mutations.toml").read_text())["mutation"]
    wrong = [each["name"] for each in listed if (REPOSITORY / each["file"]).read_text().count(each["old"]) != 1]
    assert len(listed) > 300 and wrong == []


@pytest.fixture
def script(tmp_path):
    """Run a script in a folder of its own; gives the finished process with its texts."""

    def run(name, *arguments):
        command = [sys.executable, str(SCRIPTS / name), *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)

    return run


MISTAKES = {
    "render.py none.toml": "none.toml: no such file",
    "render.py emitters.toml --size 3by4": "'3by4' is not a size",
    "render.py emitters.toml --spp 0": "'0' is not a whole number from 1",
    "render.py emitters.toml --out a.png": "'a.png' is no EXR; end it in .exr",
    "render.py emitters.toml --size 32x20 --reference small.exr": "small.exr: the image is 32x20 and the reference 16x10",
    "make_reference.py emitters.toml --out a.exr --spp 1": "--spp: 1 is not a multiple of 8",
    "make_reference.py emitters.toml --out a.exr --size 9": "'9' is not a size",
    "make_reference.py emitters.toml --out a.exr --seed -1": "'-1' is not a whole number from 0",
}


@pytest.mark.slow
@pytest.mark.parametrize("arguments", MISTAKES)
def test_mistakes_are_one_line(arguments, script, lamps_file, tmp_path):
    write_exr(tmp_path / "small.exr", {"beauty": np.ones((10, 16, 3), np.float32)})
    before = sorted(tmp_path.rglob("*"))
    finished = script(*arguments.split())
    assert (finished.returncode, finished.stdout) == (2, "")
    assert finished.stderr.count("\n") == 1 and "error: " in finished.stderr
    assert MISTAKES[arguments] in finished.stderr
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bench.py", "evaluate.py", "experiments/ztest.py"])
def test_one_reading_of_sizes(name, script):
    finished = script(name, "--size", "70000x20")
    assert finished.returncode == 2
    assert "'70000' is not a whole number from 1 to 65536" in finished.stderr


@pytest.mark.slow
def test_bench_measures_each_mode_and_the_peer(script, tmp_path):
    peers = importlib.util.find_spec("mitsuba") is not None
    options = ("--scene", "daylight", "--size", "32x18", "--spp", 4, "--warm-up", 1, "--json", "bench.json")
    finished = script("bench.py", *options, *(["--peers"] if peers else []))
    assert finished.returncode == 0, finished.stderr
    rows = json.loads((tmp_path / "bench.json").read_text())
    assert list(rows) == (["Mitsuba"] if peers else []) + ["uniform", "lis-o", "guided"]
    assert all(row["samples_per_second"] > 0.0 for row in rows.values())
    uniform, learning = rows["uniform"], rows["lis-o"]
    assert (uniform["step_cost"], uniform["candidates"]) == (1.0, 0.0)
    assert 0.0 < learning["guide_cost"] < learning["step_cost"]
    assert "| guided |" in finished.stdout and ("| Mitsuba |" in finished.stdout) == peers


@pytest.mark.slow
def test_the_check_of_a_gpu_runs_on_a_cpu(script, tmp_path):
    finished = script("gpu_check.py", "--device", "cpu", "--quick", "--json", "gpu.json")
    assert finished.returncode == 0, finished.stderr
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert [row["mode"] for row in found["means"]] == list(MODES)
    assert all(row["regions"] == 25 and 0.0 <= row["p"] <= 1.0 for row in found["means"])
    assert [row["mode"] for row in found["steps"]] == ["uniform", "lis", "lis-b", "lis-o", "guided"]
    assert all(row["M samples/s"] > 0.0 for row in found["steps"])
    assert [row["paper"] for row in found["guide"]] == [15.0, 2.0, 20.0, ""]
    assert finished.stdout.count("| guided |") == 2 and "0 of 7 tests fail" in finished.stdout


@pytest.mark.skipif(torch.cuda.is_available(), reason="torch finds a CUDA device")
def test_the_check_of_a_gpu_needs_one(script):
    finished = script("gpu_check.py")
    assert finished.returncode == 2
    assert finished.stderr == "gpu_check: error: device: cuda: torch finds no CUDA device here; give cpu\n"


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["uniform", "lis-o"])
def test_a_profile_names_what_takes_the_time(script, mode):
    finished = script("profile_step.py", "--scene", "daylight", "--mode", mode, "--size", "96x54", "--spp", 1, "--warm-up", 1)
    assert finished.returncode == 0, finished.stderr
    title, _, _, _, *rows = finished.stdout.splitlines()
    spent = {cells[0]: float(cells[1]) for cells in ([cell.strip() for cell in row.strip("|").split("|")] for row in rows)}
    whole = spent.pop("whole step, without the profiler")
    assert f"daylight {mode} 96x54" in title
    traced = {"native._trace"} if native.core() else {"tracer.intersect", "tracer.visible", "geometry.surface"}
    assert traced <= set(spent)
    assert sum(spent.values()) > 0.5 * whole  # the profiler only adds to it


@pytest.mark.slow
def test_render_writes_what_the_command_writes(script, bokehguide, lamps_file, tmp_path):
    write_exr(tmp_path / "reference.exr", {"beauty": np.ones((20, 32, 3), np.float32)})
    finished = script(*("render.py", lamps_file, "--size", "32x20", "--spp", 3, "--out", "a.exr", "--reference", "reference.exr"))
    assert finished.returncode == 0, finished.stderr
    assert bokehguide("render", lamps_file, "--spp", 3, "--out", "b.exr").returncode == 0
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), read_rgb(tmp_path / "b.exr"))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert list((tmp_path / "logs/emitters/guided").iterdir())


@pytest.mark.slow
def test_a_reference_is_the_mean_of_two_renders(script, bokehguide, lamps_file, tmp_path):
    finished = script("make_reference.py", lamps_file, "--size", "16x10", "--spp", 16, "--seed", 7, "--out", "a.exr")
    assert finished.returncode == 0, finished.stderr
    for seed in (7, 8):
        done = bokehguide("render", lamps_file, "--spp", 2, "--seed", seed, "--out", f"{seed}.exr")
        assert done.returncode == 0, done.stderr
    first, second = (read_rgb(tmp_path / f"{seed}.exr").reshape(10, 2, 16, 2, 3).mean((1, 3)) for seed in (7, 8))
    mean = read_rgb(tmp_path / "a.exr")
    np.testing.assert_allclose(mean, (first + second) / 2, rtol=1e-6)
    facts = read_metadata(tmp_path / "a.exr")
    assert (facts["spp"], facts["seed"], facts["mode"]) == (16, 7, "guided")
    between = json.loads(facts["between_halves"])
    assert between["mape"] == pytest.approx(np.mean(np.abs(first - second) / (mean + 0.01)), rel=1e-4)
    assert between["relmse"] == pytest.approx(np.mean(((first - second) / (mean + 0.01)) ** 2), rel=1e-4)


@pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed")
@pytest.mark.parametrize("denoise", [(), ("--denoise",)])
def test_equal_time_gives_both_their_seconds(script, tmp_path, denoise):
    options = ("--size", "32x18", "--seconds", 2, "--reference-spp", 16, "--cache", "cache", "--out", "out")
    finished = script("equal_time.py", "daylight", *options, *denoise)
    assert finished.returncode == 0, finished.stderr
    histories = json.loads((tmp_path / "out/equal_time.json").read_text())["daylight"]
    assert 0.0 < histories.pop("reference_error")["frame"] < 0.5
    assert histories.keys() == {"guided", "Mitsuba"}
    for history in histories.values():
        assert history[-1]["seconds"] >= 2.0 and history[-1]["spp"] >= 1
        assert history[-1]["mape"]["frame"] < (0.3 if denoise else 1.0), "both show the same scene"
    assert "| daylight | frame | 2 |" in finished.stdout
    assert (tmp_path / "out/equal_time.png").stat().st_size > 10_000


@pytest.mark.skipif(not ASSETS.is_dir(), reason="the real models are absent")
def test_equal_time_measures_real_models_against_a_mode(script, tmp_path):
    options = ("--size", "32x18", "--seconds", 1, "--reference-spp", 16, "--cache", "cache", "--out", "out")
    finished = script("equal_time.py", "real-truck", "--against", "uniform", *options)
    assert finished.returncode == 0, finished.stderr
    histories = json.loads((tmp_path / "out/equal_time.json").read_text())["real-truck"]
    assert histories.pop("reference_error").keys() == {"frame", "insets", "inset-1", "inset-2", "inset-3"}
    assert histories.keys() == {"guided", "uniform"}
    for history in histories.values():
        assert history[-1]["mape"].keys() == {"frame", "insets", "inset-1", "inset-2", "inset-3"}
    assert "| MAPE of uniform |" in finished.stdout


def raising(error: BaseException):
    def main():
        raise error

    return main


@pytest.mark.parametrize(
    ("main", "code", "line"),
    [
        (lambda: None, 0, ""),
        (lambda: 1, 1, ""),
        (raising(BokehguideError("a.exr: is no picture")), 2, "script: error: a.exr: is no picture\n"),
        (raising(KeyboardInterrupt()), 130, "script: interrupted; all is kept\n"),
    ],
)
def test_how_scripts_end(main, code, line, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["scripts/script.py"])
    with pytest.raises(SystemExit) as ended:
        run(main, "all is kept")
    assert (ended.value.code or 0, capsys.readouterr().err) == (code, line)


@pytest.mark.parametrize("length", [1, 1000000])
def test_a_script_whose_reader_is_gone_ends_without_a_traceback(length):
    """As with `| head`: the output is lost while it is written, or when it is flushed at the end."""
    reader, writer = os.pipe()
    os.close(reader)
    text = f"from bokehguide.cli.scripts import run; run(lambda: print('x' * {length}))"
    ended = subprocess.run([sys.executable, "-c", text], stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (141, "")
