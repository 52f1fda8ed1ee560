"""`bokehguide compare`: its numbers, tables and pictures, what it keeps, and the user's mistakes."""

import json
import re
import signal
import subprocess
import sys
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bokehguide.cli import main
from bokehguide.image import Display, read_metadata, read_rgb, to_8_bit, write_exr
from bokehguide.metrics import mape, relmse
from bokehguide.scene import BUILTIN, Inset

MODES, SPP, SIZE = ("uniform", "lis-o"), 5, (32, 18)
REGIONS = ["frame", "insets", "inset-1", "inset-2", "inset-3"]
FILES = {"metrics.json", "table.md", "convergence.png", "insets.png", "reference.exr", "logs"}


def compare(folder: Path, *options: object) -> subprocess.CompletedProcess:
    """The real command on a built-in scene; all goes into `folder`."""
    command = [sys.executable, "-m", "bokehguide", "compare", "cutout", "--modes", ",".join(MODES), "--spp", str(SPP)]
    command += ["--size", "x".join(map(str, SIZE)), "--out", "out", "--cache", "cache", *map(str, options)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder in which the command has run once."""
    folder = tmp_path_factory.mktemp("compared")
    finished = compare(folder)
    assert finished.returncode == 0, finished.stderr
    assert (folder / "out/table.md").read_text() in finished.stdout
    return folder


@pytest.fixture(scope="module")
def metrics(folder) -> dict:
    return json.loads((folder / "out/metrics.json").read_text())


def radiance(path: Path) -> torch.Tensor:
    return torch.from_numpy(read_rgb(path))


@cache
def insets() -> tuple[Inset, ...]:
    return BUILTIN["cutout"]().insets


def crops(image: torch.Tensor) -> list[torch.Tensor]:
    return [image[inset.pixels(*SIZE)] for inset in insets()]


def colors(image: torch.Tensor, display: Display) -> set[tuple]:
    """As the screen shows them."""
    return {tuple(color) for color in to_8_bit(display.show(image)).reshape(-1, 3)}


def test_everything_is_written(folder, metrics):
    pictures = {f"{mode}.{kind}" for mode in MODES for kind in ("exr", "png")}
    assert {path.name for path in (folder / "out").iterdir()} == FILES | pictures
    facts = {"scene": "cutout", "size": "32x18", "spp": SPP, "device": "cpu"}
    assert {name: metrics[name] for name in facts} == facts
    assert list(metrics["modes"]) == list(metrics["runs"]) == list(MODES)
    for mode in MODES:
        header = read_metadata(folder / f"out/{mode}.exr")
        assert (header["mode"], header["spp"], header["seed"]) == (mode, SPP, metrics["seed"])


def test_errors_are_those_of_the_pictures(folder, metrics):
    reference = radiance(folder / "out/reference.exr")
    for mode in MODES:
        image = radiance(folder / f"out/{mode}.exr")
        for name, measure in (("mape", mape), ("relmse", relmse)):
            found = metrics["modes"][mode][name]
            assert list(found) == REGIONS
            assert found["frame"] == pytest.approx(measure(image, reference), rel=1e-5)
            boxes = [measure(*pair) for pair in zip(crops(image), crops(reference))]
            assert [found[region] for region in REGIONS[2:]] == pytest.approx(boxes, rel=1e-5)
            # The insets of this scene do not overlap.
            sizes = [crop.numel() for crop in crops(image)]
            assert found["insets"] == pytest.approx(np.average(boxes, weights=sizes), rel=1e-5)


def test_curves_of_every_step(metrics):
    for mode in MODES:
        run, facts = metrics["runs"][mode], metrics["modes"][mode]
        assert len(run["seconds"]) == len(run["rays"]) == SPP
        assert run["seconds"] == sorted(run["seconds"]) and run["rays"] == sorted(run["rays"])
        assert run["rays"][0] >= SIZE[0] * SIZE[1]
        assert (facts["seconds"], facts["rays"]) == (run["seconds"][-1], run["rays"][-1])
        for region in REGIONS:
            for measure in ("mape", "relmse"):
                curve = run["errors"][region][measure]
                assert len(curve) == SPP and facts[measure][region] == pytest.approx(curve[-1])


@pytest.mark.parametrize(
    ("cost", "budget", "at"), [("rays", "equal_rays", "at_equal_rays"), ("seconds", "equal_seconds", "at_equal_time")]
)
def test_errors_at_the_cheapest_mode_s_budget(cost, budget, at, metrics):
    modes = metrics["modes"]
    cheapest = min(modes, key=lambda mode: modes[mode][cost])
    assert metrics[budget] == modes[cheapest][cost]
    for mode, facts in modes.items():
        run = metrics["runs"][mode]
        after = next(step for step in range(SPP) if run[cost][step] >= metrics[budget])
        if after == 0 and run[cost][0] > metrics[budget]:
            assert facts[at]["mape"]["frame"] is None
            continue
        curve = run["errors"]["frame"]["mape"]
        between = sorted(curve[max(after - 1, 0) : after + 1])
        assert between[0] * 0.999999 <= facts[at]["mape"]["frame"] <= between[-1] * 1.000001
    assert modes[cheapest][at]["mape"] == pytest.approx(modes[cheapest]["mape"])


def test_the_reference_tells_how_good_it_is(folder, metrics):
    first, second = (radiance(path) for path in sorted(folder.glob("cache/*/cutout-32x18-guided-*.exr")))
    mean = radiance(folder / "out/reference.exr")
    torch.testing.assert_close(mean, (first + second) / 2)
    facts = metrics["reference"]
    assert (facts["mode"], facts["spp"]) == ("guided", 16 * SPP)
    assert facts["between_halves"]["frame"]["mape"] == pytest.approx(
        ((first - second).abs() / (mean + 0.01)).mean().item(), rel=1e-4
    )
    apart = facts["between_halves"]["insets"]["mape"]
    text = (folder / "out/table.md").read_text()
    assert f"{apart:.4f} over the insets" in text and f"{apart / 2:.4f}, is part of all errors" in text


def test_the_tables_say_what_the_json_says(folder, metrics):
    lines = (folder / "out/table.md").read_text().splitlines()
    assert lines[0] == "# cutout, 32x18, 5 SPP"
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    heads = [row for row in rows if row[0] == "mode"]
    assert [head[1:4] for head in heads] == [
        ["MAPE frame", "MAPE insets", "MAPE inset 1"],
        ["seconds", "million rays", "rays per sample"],
    ]
    for mode in MODES:
        errors, costs = (row for row in rows if row[0] == mode)
        facts, first = metrics["modes"][mode], metrics["modes"]["uniform"]
        assert errors[2] == f"{facts['mape']['insets']:.4f} ({facts['mape']['insets'] / first['mape']['insets']:.3f})"
        assert float(errors[-1].split()[0]) == pytest.approx(facts["relmse"]["insets"], abs=1e-4)
        assert float(costs[2]) == pytest.approx(facts["rays"] / 1e6, rel=1e-3)
        assert float(costs[5].split()[0]) == pytest.approx(facts["at_equal_rays"]["mape"]["insets"], abs=1e-4)


@pytest.mark.slow
def test_the_figures(folder):
    with Image.open(folder / "out/convergence.png") as picture:
        assert picture.size == (2160, 1470)
        assert np.asarray(picture.convert("L")).std() > 10
    with Image.open(folder / "out/insets.png") as picture:
        assert picture.width == 2160
        shown = {tuple(color) for color in np.asarray(picture.convert("RGB")).reshape(-1, 3)}
    display = Display().metered(radiance(folder / "out/reference.exr"))
    shows = partial(colors, display=display)
    pictures = {}
    for name in (*MODES, "reference"):
        pictures[name] = radiance(folder / f"out/{name}.exr")
        for crop in crops(pictures[name]):
            assert len(shows(crop) & shown) > 0.98 * len(shows(crop)), name
    for mode in MODES:
        outside = shows(pictures[mode]) - shows(pictures["reference"]) - set().union(*map(shows, crops(pictures[mode])))
        assert len(outside) > 50 and len(outside & shown) < 0.1 * len(outside), "of a mode only the crops are shown"


def test_the_logs(folder, metrics):
    for mode in MODES:
        log = EventAccumulator(str(folder / "out/logs/cutout" / mode), size_guidance={"scalars": 0}).Reload()
        errors = metrics["runs"][mode]["errors"]
        for tag, curve in (("mape", errors["frame"]["mape"]), ("relmse_inset-2", errors["inset-2"]["relmse"])):
            assert [event.value for event in log.Scalars(f"error/{tag}")] == pytest.approx(curve, rel=1e-6)


@pytest.mark.slow
def test_a_second_run_renders_nothing(folder):
    rendered = [
        *folder.glob("cache/**/*.exr"),
        *(folder / f"out/{mode}.exr" for mode in MODES),
        *folder.glob("out/logs/**/events*"),
    ]
    before = {path: path.stat().st_mtime_ns for path in rendered}
    runs = json.loads((folder / "out/metrics.json").read_text())
    figure = (folder / "out/insets.png").read_bytes()
    finished = compare(folder)
    assert finished.returncode == 0, finished.stderr
    assert [line for line in finished.stdout.splitlines() if "kept" in line] == [f"{mode}: kept, 5 SPP" for mode in MODES]
    assert {path: path.stat().st_mtime_ns for path in rendered} == before
    assert json.loads((folder / "out/metrics.json").read_text()) == runs
    assert (folder / "out/insets.png").read_bytes() == figure


@pytest.fixture
def emitters(lamps_file, tmp_path, monkeypatch, capfd):
    """Compare on the emitters, against a given reference unless told otherwise; gives metrics and what was said."""
    monkeypatch.chdir(tmp_path)
    write_exr("given.exr", {"beauty": np.full((20, 32, 3), 0.1, np.float32)})

    def run(*options, against=("--reference", "given.exr")):
        capfd.readouterr()
        assert main(["compare", "emitters.toml", "--spp", "2", "--out", "out", *against, *options]) == 0
        return json.loads(Path("out/metrics.json").read_text()), capfd.readouterr().out

    return run


@pytest.mark.slow
def test_a_given_reference_and_insets_of_the_command_line(emitters):
    found, said = emitters("--modes", "uniform", "--inset", "0,0,0.5,0.5", "--inset", "0.5,0.25,0.25,0.5")
    image = read_rgb("out/uniform.exr")
    assert found["modes"]["uniform"]["mape"]["inset-2"] == pytest.approx(np.abs(image[5:15, 16:24] - 0.1).mean() / 0.11, rel=1e-5)
    assert found["reference"]["path"] == "given.exr" and "Its own error is unknown" in said
    assert not Path("out/reference.exr").exists()
    found, _ = emitters("--modes", "uniform")
    assert list(found["modes"]["uniform"]["mape"]) == ["frame"]
    with Image.open("out/insets.png") as picture:
        assert picture.width > 4 * picture.height / 2 > 500


@pytest.mark.slow
def test_a_reference_that_was_made_can_be_given(emitters):
    emitters("--modes", "uniform", against=("--cache", "cache", "--reference-spp", "7"))
    header = read_metadata("out/reference.exr")
    assert header["spp"] == 8 and json.loads(header["between_halves"]).keys() == {"mape", "relmse"}
    found, said = emitters("--modes", "uniform", against=("--reference", "out/reference.exr"))
    assert "uniform: kept, 2 SPP" in said
    assert found["reference"]["between_halves"]["frame"]["mape"] > 0


@pytest.mark.slow
def test_what_the_scene_holds_decides_what_is_kept(emitters, lamps_file):
    first, _ = emitters("--modes", "uniform", against=("--cache", "cache"))
    lamps_file.write_text(lamps_file.read_text().replace("[40.0, 30.0, 20.0]", "[40.0, 30.0, 20.5]"))
    second, said = emitters("--modes", "uniform", against=("--cache", "cache"))
    assert "uniform: rendered again, as the scene" in said
    assert first["reference"]["digest"] != second["reference"]["digest"]
    assert len(list(Path("cache").iterdir())) == 2
    assert first["modes"]["uniform"]["mape"] != second["modes"]["uniform"]["mape"]


def interrupted_comparison(folder: Path, options: list[str], moment: str) -> str:
    """stderr of `compare` with SIGINT as soon as stderr contains the regular expression `moment`."""
    command = [sys.executable, "-m", "bokehguide", "compare", "emitters.toml", *options]
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    # A shell's background jobs ignore Ctrl-C, and so would what these tests start there.
    heeds = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(command, cwd=folder, preexec_fn=heeds, **pipes) as process:
        stderr = ""
        while not re.search(moment, stderr, re.DOTALL) and process.poll() is None:
            stderr += process.stderr.read(1)
        process.send_signal(signal.SIGINT)
        stderr += process.communicate(timeout=60)[1]
    assert process.returncode == 130 and "Traceback" not in stderr, stderr
    return stderr


@pytest.mark.slow
def test_an_interrupted_comparison_keeps_what_is_finished(lamps_file, tmp_path):
    write_exr(tmp_path / "given.exr", {"beauty": np.full((20, 32, 3), 0.1, np.float32)})
    options = ["--reference", "given.exr", "--spp", "400", "--out", "out", "--modes"]
    stderr = interrupted_comparison(tmp_path, [*options, "uniform,lis"], "emitters lis:.*/s, MAPE")
    assert stderr.endswith("bokehguide: finished modes are kept; the same command continues\nbokehguide: interrupted\n")
    assert json.loads((tmp_path / "out/metrics.json").read_text())["runs"].keys() == {"uniform"}
    command = [sys.executable, "-m", "bokehguide", "compare", "emitters.toml", *options, "uniform"]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert finished.returncode == 0 and "uniform: kept, 400 SPP" in finished.stdout


@pytest.mark.slow
def test_an_interrupted_reference_keeps_its_samples_and_says_so(lamps_file, tmp_path):
    options = ["--reference-spp", "4000", "--cache", "cache", "--spp", "4", "--out", "out", "--modes", "uniform"]
    stderr = interrupted_comparison(tmp_path, options, r"guided-first:.* \d\d+/2000")
    kept = "bokehguide: samples of the reference and finished modes are kept; the same command continues\n"
    assert stderr.endswith(f"{kept}bokehguide: interrupted\n")
    (half,) = tmp_path.glob("cache/*/*-first.exr")
    assert int(read_metadata(half)["spp"]) >= 10


MISTAKES = {
    "--modes uniform,lis-x": ["lis-x", "uniform", "lis-o"],
    "--modes": ["--modes", "expected one argument"],
    "--modes lis,lis": ["--modes", "twice"],
    "--modes lis,": ["--modes: invalid choice: ''; known are uniform, lis, "],
    "--spp 0": ["--spp", "'0'"],
    "--reuse-radius 0": ["error: --reuse-radius: 0.0 is out of range"],
    "--reuse-radius 8 --modes uniform,lis": ["--reuse-radius: 8 has no effect in uniform, lis; leave it out, or choose area-"],
    "--reference good.exr --cache c": ["--cache: 'c' has no effect with --reference"],
    "--inset 0.8,0,0.5,0.5": ["--inset", "leaves the frame"],
    "--reference none.exr": ["none.exr", "cannot be read"],
    "--reference small.exr": ["small.exr: ", "32x20", "16x10"],
    "--reference good.exr --reference-spp 4": ["--reference-spp", "--reference"],
    "--reference uniform.exr --out .": ["--reference", "uniform.exr", "is an output of this command"],
    "--out emitters.toml/deep": ["emitters.toml/deep", "cannot be written", "another folder"],
    "--out cut": ["cut/metrics.json", "damaged", "another folder"],
    "--out other": ["other/metrics.json", "no file of `compare`", "another folder"],
    "--out ragged": ["ragged/metrics.json", "damaged"],
    "--out blocked": ["blocked/insets.png", "is a folder"],
    "--cache emitters.toml": ["emitters.toml", "cannot be written", "choose another folder for references, with --cache\n"],
}


@pytest.mark.parametrize("options", MISTAKES)
def test_mistakes_are_told_before_anything_is_rendered(options, lamps_file, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_exr("small.exr", {"beauty": np.ones((10, 16, 3), np.float32)})
    for name in ("good", "uniform"):
        write_exr(f"{name}.exr", {"beauty": np.ones((20, 32, 3), np.float32)})
    ragged = {
        "uniform": {
            "run_fingerprint": "a",
            "seconds": [1, 2],
            "rays": [3],
            "errors": {"frame": {"mape": [1, 1], "relmse": [1, 1]}},
        }
    }
    for name, text in (("cut", '{"runs": {'), ("other", '{"mode": "lis"}'), ("ragged", json.dumps({"runs": ragged}))):
        Path(name).mkdir()
        Path(name, "metrics.json").write_text(text)
    Path("blocked/insets.png").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*.exr"))
    assert main(["compare", "emitters.toml", "--out", "new", *options.split()]) == 2
    out, err = capfd.readouterr()
    assert (out, err[:19], err.count("\n")) == ("", "bokehguide: error: ", 1)
    for words in MISTAKES[options]:
        assert words in err, err
    assert sorted(tmp_path.rglob("*.exr")) == before


def test_out_has_to_be_given(capfd):
    assert main(["compare", "cutout"]) == 2
    assert "--out" in capfd.readouterr().err
