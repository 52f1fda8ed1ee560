"""`bokehguide render --resume`: after its end, after signals, after being killed."""

import errno
import fcntl
import json
import os
import pkgutil
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bokehguide import __version__
from bokehguide.cli import main
from bokehguide.cli.pictures import Pictures
from bokehguide.cli.sole_writer import sole_writer
from bokehguide.errors import BokehguideError
from bokehguide.image import read_exr, read_metadata, write_exr
from bokehguide.scene import load_scene
from bokehguide.train import RenderLoop, RenderSettings, load_checkpoint, save_checkpoint

KILLS = 5
KEEP = ("--checkpoint-every", 60)
"""Options with which a finished render keeps its checkpoint."""


@pytest.fixture
def render(lamps_file, tmp_path, monkeypatch):
    """Run `bokehguide render emitters.toml --out a.exr …` in this process and the test's folder; gives its exit code."""
    monkeypatch.chdir(tmp_path)

    def run(*options: object, out: str = "a.exr") -> int:
        return main(["render", "emitters.toml", "--threads", "1", "--out", out, *map(str, options)])

    return run


def started(folder, *options: object) -> subprocess.Popen:
    """The same as a process of its own, that has no end and saves after every step."""
    command = [sys.executable, "-m", "bokehguide", "render", "emitters.toml", "--threads", "1", "--out", "a.exr"]
    command += ["--spp", "1000000", "--checkpoint-every", "1e-6", *map(str, options)]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(process: subprocess.Popen, happened) -> None:
    deadline = time.monotonic() + 60
    while not happened():
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.005)


def assert_same_pictures(one, other) -> None:
    first, second = read_exr(one), read_exr(other)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def kept_spp(path, mode: str) -> int:
    loop = RenderLoop(load_scene("emitters.toml"), RenderSettings(mode, threads=1))
    load_checkpoint(path, loop)
    return loop.step_number


def test_a_time_limit_keeps_the_state_of_a_resumed_render(render, tmp_path, capsys):
    """Session by session until all SPP are there; then the file goes."""
    session = ("--spp", 5, "--resume", "--time-limit", 1e-3, "--json", "a.json")
    for spp in (1, 2, 3):
        assert render(*session) == 0
        assert json.loads((tmp_path / "a.json").read_text())["spp"] == spp
        assert "--resume continues it to more SPP" in capsys.readouterr().out
    assert render(*session[:3]) == 0
    assert not (tmp_path / "a.ckpt").exists()
    assert render("--spp", 5, out="b.exr") == 0
    assert_same_pictures("a.exr", "b.exr")


def test_a_time_limit_without_resume_keeps_no_state(render, tmp_path):
    assert render("--spp", 5, "--time-limit", 1e-3) == 0
    assert not (tmp_path / "a.ckpt").exists()


def test_a_crop_whose_sum_is_negative_is_resumed(tmp_path, monkeypatch):
    """On two pixels, the control variate of the first steps may leave less than nothing."""
    monkeypatch.chdir(tmp_path)
    crop = ["render", "glitter", "--size", "160x90", "--crop", "82,41,1,2", "--seed", "174", "--threads", "1", *map(str, KEEP)]
    assert main([*crop, "--spp", "3"]) == 0
    beauty = read_exr("glitter-guided.exr")
    assert sum(float(beauty[channel].sum()) for channel in "RGB") < 0.0
    assert main([*crop, "--spp", "4", "--resume"]) == 0


def test_samples_are_added_to_a_finished_render(render, tmp_path, capsys):
    assert render("--spp", 4, "--json", "a.json", *KEEP) == 0
    first = json.loads((tmp_path / "a.json").read_text())
    assert "wrote a.ckpt (0.3 MB); --resume continues it to more SPP" in capsys.readouterr().out
    assert render("--spp", 9, "--resume", "--json", "a.json") == 0
    assert "bokehguide: resuming a.ckpt at 4 SPP" in capsys.readouterr().err
    assert render("--spp", 9, out="b.exr") == 0
    assert_same_pictures("a.exr", "b.exr")
    header = read_metadata("a.exr")
    assert header["spp"] == 9 and "--spp=9" in header["command"] and "resume" not in header["command"]
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["spp"] == 9 and report["seconds"] > first["seconds"]
    assert all(report["phases"][phase] >= seconds for phase, seconds in first["phases"].items() if phase != "output")
    assert sum(report["phases"].values()) == pytest.approx(report["seconds"], rel=0.02)
    assert report["samples_per_second"] == pytest.approx(9 * 640 / report["seconds"])


def test_a_finished_render_is_written_again(render, tmp_path):
    write_exr("reference.exr", {"beauty": np.full((20, 32, 3), 0.1, np.float32)})
    assert render("--spp", 3, "--reference", "reference.exr", "--json", "a.json", *KEEP) == 0
    kept, first = read_exr("a.exr"), json.loads((tmp_path / "a.json").read_text())
    (tmp_path / "a.exr").unlink()
    assert render("--spp", 3, "--reference", "reference.exr", "--json", "a.json", "--resume") == 0
    np.testing.assert_array_equal(read_exr("a.exr")["R"], kept["R"])
    again = json.loads((tmp_path / "a.json").read_text())
    assert (again["mape"], again["gaussians"], again["spp"]) == (first["mape"], first["gaussians"], 3)


def test_without_a_checkpoint_it_starts_anew_and_says_so(render, capsys):
    assert render("--spp", 2, "--resume") == 0
    said = "bokehguide: no a.ckpt to resume; starting from the first step (a finished render keeps one with --checkpoint-every"
    assert said in capsys.readouterr().err
    assert read_metadata("a.exr")["spp"] == 2


@pytest.mark.slow
def test_starting_anew_by_mistake_loses_nothing(render, capsys):
    """Of the same render; the checkpoint of another one gets another name."""
    assert render("--spp", 5, "--mode", "uniform", *KEEP) == 0
    capsys.readouterr()
    assert render("--spp", 3, "--mode", "uniform") == 0
    assert "a.ckpt has 5 SPP of this render and stays until this run has more; see --resume" in capsys.readouterr().err
    assert kept_spp("a.ckpt", "uniform") == 5 and read_metadata("a.exr")["spp"] == 3
    assert render("--spp", 6, "--mode", "uniform") == 0
    assert kept_spp("a.ckpt", "uniform") == 6
    capsys.readouterr()
    assert render("--spp", 2, "--mode", "lis", *KEEP) == 0
    assert "a.ckpt has" not in capsys.readouterr().err
    assert kept_spp("a.ckpt", "lis") == 2
    assert kept_spp("a-2.ckpt", "uniform") == 6


def test_the_checkpoint_of_another_render_gets_another_name(render, tmp_path, capsys):
    """Before the first save; a render that saves nothing leaves the file."""
    assert render("--spp", 3, "--mode", "uniform", *KEEP) == 0
    whole = (tmp_path / "a.ckpt").read_bytes()
    assert render("--spp", 2, "--mode", "lis") == 0
    assert (tmp_path / "a.ckpt").read_bytes() == whole
    (tmp_path / "a-2.exr").touch()
    capsys.readouterr()
    assert render("--spp", 2, "--mode", "lis", "--checkpoint-every", "1e-6") == 0
    told = "a.ckpt was of another render and is a-3.ckpt now; that render's options with --out a-3.exr --resume continue it\n"
    assert capsys.readouterr().err.count(told) == 1
    assert (tmp_path / "a-3.ckpt").read_bytes() == whole and kept_spp("a.ckpt", "lis") == 2
    assert sorted(path.name for path in tmp_path.glob("*.ckpt")) == ["a-3.ckpt", "a.ckpt"]
    assert render("--spp", 4, "--mode", "uniform", "--resume", out="a-3.exr") == 0
    assert read_metadata("a-3.exr")["spp"] == 4


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("text", "a.ckpt is no readable checkpoint of bokehguide and is a-2.ckpt now\n"),
        ("state of a model", "a.ckpt is no readable checkpoint of bokehguide and is a-2.ckpt now\n"),
        ("cut", "a.ckpt is no readable checkpoint of bokehguide and is a-2.ckpt now\n"),
        ("version", "a.ckpt was written by bokehguide 0.3.0 and is a-2.ckpt now; that version continues it\n"),
        (
            "commit",
            f"a.ckpt was written by another commit of bokehguide {__version__} and is a-2.ckpt now; that version continues",
        ),
    ],
)
def test_any_other_file_gets_another_name(content, told, render, tmp_path, capsys):
    loop = RenderLoop(load_scene("emitters.toml"), RenderSettings("uniform", threads=1))
    loop.step()
    save_checkpoint(tmp_path / "a.ckpt", loop, 1.0)
    whole = torch.load(tmp_path / "a.ckpt", weights_only=True)
    if content == "text":
        (tmp_path / "a.ckpt").write_text("Mine.\n" * 99)
    elif content == "cut":
        (tmp_path / "a.ckpt").write_bytes((tmp_path / "a.ckpt").read_bytes()[:5000])
    elif content == "state of a model":
        torch.save({"weight": torch.zeros(3)}, tmp_path / "a.ckpt")
    else:
        whole["fingerprint"] |= {"software": "bokehguide 0.3.0"} if content == "version" else {"fewer": "inputs"}
        torch.save(whole, tmp_path / "a.ckpt")
    before = (tmp_path / "a.ckpt").read_bytes()
    assert render("--spp", 2, "--mode", "uniform") == 0
    assert (tmp_path / "a.ckpt").read_bytes() == before
    capsys.readouterr()
    assert render("--spp", 3, "--mode", "uniform", "--checkpoint-every", "1e-6") == 0
    assert capsys.readouterr().err.count(f"bokehguide: {told}") == 1
    assert (tmp_path / "a-2.ckpt").read_bytes() == before and kept_spp("a.ckpt", "uniform") == 3


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--seed", 9, "--f-number", 2), r"Differences: seed was 4 and is 9, camera\.aperture_radius was 0\.\d+ and is 0\.\d+"),
        (("--seed", 4, "--environment", "1,2,3"), "Differences: other environment"),
        (
            ("--seed", 9, "--size", "20x10", "--max-depth", 2, "--crop", "0,0,8,8", "--fov", 30),
            r"Differences: seed was 4 and is 9, size was \d+x\d+ and is 20x10, max_depth was \d+ and is 2, crop was None .* more",
        ),
    ],
)
def test_the_message_of_a_renamed_checkpoint_names_the_differences(options, told, render, capsys):
    assert render("--spp", 1, "--mode", "uniform", "--seed", 4, *KEEP) == 0
    capsys.readouterr()
    assert render("--spp", 1, "--mode", "uniform", *options, "--checkpoint-every", "1e-6") == 0
    renamed = ".*bokehguide: a.ckpt was of another render and is a-2.ckpt now; .* --resume continue it"
    assert len(re.findall(f"^{renamed}\n{told}$", capsys.readouterr().err, re.MULTILINE)) == 1


def test_an_empty_file_is_replaced(render, tmp_path, capsys):
    (tmp_path / "a.ckpt").touch()
    assert render("--spp", 2, "--mode", "uniform", "--checkpoint-every", "1e-6") == 0
    assert "is no readable" not in capsys.readouterr().err and [path.name for path in tmp_path.glob("*.ckpt")] == ["a.ckpt"]


def test_files_with_another_name_are_counted_from_the_second_on(render, tmp_path, capsys):
    for name in ("a-b.ckpt", "b-2.ckpt"):
        (tmp_path / name).write_bytes(bytes(2**20))
    for seed in range(4):
        capsys.readouterr()
        assert render("--spp", 1, "--mode", "uniform", "--seed", seed, "--checkpoint-every", "1e-6") == 0
        size = sum(path.stat().st_size for path in tmp_path.glob("a-[0-9].ckpt")) / 2**20
        told = f"bokehguide: {seed} files a-NUMBER.ckpt take {size:.1f} MB; remove the files that no render continues\n"
        error = capsys.readouterr().err
        assert (error.count(told), error.count("NUMBER")) == ((1, 1) if seed > 1 else (0, 0))


def test_a_restarted_job_loads_a_checkpoint_of_its_own_render_alone(render, capsys, monkeypatch):
    """Without --resume, the checkpoint of another render is the user's, and no reason to end."""
    assert render("--spp", 2, "--mode", "uniform", "--seed", 4, *KEEP) == 0
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    capsys.readouterr()
    mine = ("--mode", "uniform", "--seed", 9)
    assert render("--spp", 2, *mine, "--checkpoint-every", "1e-6") == 0
    assert "a.ckpt was of another render and is a-2.ckpt now" in capsys.readouterr().err
    assert render("--spp", 4, *mine) == 0
    assert "resuming a.ckpt at 2 SPP" in capsys.readouterr().err
    assert render("--spp", 3, *mine) == 0 and read_metadata("a.exr")["spp"] == 3
    assert "a.ckpt has 4 SPP of this render and stays until this run has more" in capsys.readouterr().err
    assert render("--spp", 5, "--mode", "uniform", "--seed", 4, "--resume") == 2
    assert "a.ckpt: is of another render: seed was 9 and is 4" in capsys.readouterr().err


def test_a_restarted_job_with_a_time_limit_keeps_no_state(render, tmp_path, monkeypatch):
    loop = RenderLoop(load_scene("emitters.toml"), RenderSettings("guided", threads=1))
    loop.step()
    save_checkpoint(tmp_path / "a.ckpt", loop, 1.0, kept=False)
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    assert render("--spp", 5, "--time-limit", 1e-3) == 0
    assert read_metadata("a.exr")["spp"] == 2 and not (tmp_path / "a.ckpt").exists()


def test_a_finished_render_leaves_no_checkpoint(render, tmp_path, capsys, monkeypatch):
    """The state is still saved at intervals, for a crash."""
    monkeypatch.setattr("bokehguide.cli.checkpoints.INTERVAL", 1e-6)
    saved = []
    monkeypatch.setattr(Pictures, "refresh", lambda self, loop: saved.append((tmp_path / "a.ckpt").exists()))
    assert render("--spp", 4) == 0
    assert saved == [True] * 3 and not (tmp_path / "a.ckpt").exists()
    assert "ckpt" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_checkpoint_that_was_asked_for_stays(render, tmp_path, monkeypatch):
    """Also when a later command, without the option, adds samples."""
    monkeypatch.setattr("bokehguide.cli.checkpoints.INTERVAL", 1e-6)
    assert render("--spp", 3, *KEEP) == 0
    assert render("--spp", 4, "--resume") == 0
    assert kept_spp(tmp_path / "a.ckpt", "guided") == 4
    assert render("--spp", 2) == 0
    assert kept_spp(tmp_path / "a.ckpt", "guided") == 4
    assert render("--spp", 5) == 0
    assert kept_spp(tmp_path / "a.ckpt", "guided") == 5


def test_an_interrupted_render_that_is_finished_later_leaves_none(render, tmp_path):
    loop = RenderLoop(load_scene("emitters.toml"), RenderSettings("guided", threads=1))
    loop.step()
    save_checkpoint(tmp_path / "a.ckpt", loop, 1.0, kept=False)
    assert render("--spp", 3, "--resume") == 0
    assert not (tmp_path / "a.ckpt").exists()
    save_checkpoint(tmp_path / "a.ckpt", loop, 1.0, kept=False)
    assert render("--spp", 1) == 0 and render("--spp", 3) == 0
    assert not (tmp_path / "a.ckpt").exists()


@pytest.mark.parametrize("step", ["many", -3, None, 2.5])
def test_a_checkpoint_with_a_wrong_step_beside_a_new_render(step, render, tmp_path):
    assert render("--spp", 2, *KEEP) == 0
    whole = torch.load(tmp_path / "a.ckpt", weights_only=True)
    whole["loop"]["step"] = step
    torch.save(whole, tmp_path / "a.ckpt")
    assert render("--spp", 2) == 0 and read_metadata("a.exr")["spp"] == 2


def test_no_checkpoint_where_none_is_wanted(render, tmp_path, capsys):
    assert render("--spp", 2, "--checkpoint-every", 0) == 0
    assert not (tmp_path / "a.ckpt").exists() and "ckpt" not in capsys.readouterr().out


@pytest.mark.slow
def test_what_cannot_be_resumed_is_one_line_and_changes_nothing(render, tmp_path, capsys):
    assert render("--spp", 3, "--mode", "lis", *KEEP) == 0
    written = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    mistakes = {
        ("--mode", "lis", "--spp", 2): "has 3 SPP already; give --spp 3 or more",
        ("--mode", "lis", "--seed", 1): "seed was 0 and is 1",
        ("--mode", "lis-b"): "mode was lis and is lis-b",
        ("--mode", "lis", "--size", "16x10"): "size was 32x20 and is 16x10",
        ("--mode", "lis", "--fov", 41): "camera.fov was 40.0 and is 41.0",
        ("--mode", "lis", "--environment", "1,1,1"): "other environment",
    }
    for options, named in mistakes.items():
        capsys.readouterr()
        assert render(*options, "--resume") == 2
        error = capsys.readouterr().err
        assert error.startswith("bokehguide: error: a.ckpt: ") and named in error and error.count("\n") == 1
    (tmp_path / "a.ckpt").write_bytes(written["a.ckpt"][:5000])
    assert render("--mode", "lis", "--resume") == 2
    assert "a.ckpt: is damaged or no checkpoint of a render" in capsys.readouterr().err
    (tmp_path / "a.ckpt").write_bytes(written["a.ckpt"])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == written


def test_a_checkpoint_that_cannot_be_written_ends_no_render(render, tmp_path, capsys):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (80_000, limits[1]))  # room for the picture
    try:
        assert render("--spp", 3, "--checkpoint-every", 1e-6) == 0
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    out, error = capsys.readouterr()
    assert "bokehguide: warning: a.ckpt: cannot be written" in error and "ckpt" not in out
    assert read_metadata("a.exr")["spp"] == 3 and not (tmp_path / "a.ckpt").exists()


@pytest.mark.parametrize(
    ("number", "code", "mode"),
    [(signal.SIGINT, 130, "guided"), pytest.param(signal.SIGTERM, 143, "lis-o", marks=pytest.mark.slow)],
)
def test_a_signal_finishes_the_step_and_saves(number, code, mode, render, tmp_path):
    with started(tmp_path, "--mode", mode) as process:
        wait_for(process, (tmp_path / "a.ckpt").exists)
        process.send_signal(number)
        stderr = process.communicate(timeout=60)[1]
    assert process.returncode == code, stderr
    spp = read_metadata("a.exr")["spp"]
    said = f"bokehguide: interrupted at {spp} of 1000000 SPP; saved, --resume continues from a.ckpt"
    assert said in stderr and "Traceback" not in stderr
    told = "finishing the step and saving; a second interruption during the step discards the samples since the last save\n"
    assert stderr.count(told) == 1
    assert kept_spp("a.ckpt", mode) == spp
    assert render("--mode", mode, "--spp", spp + 3, "--resume") == 0
    assert render("--mode", mode, "--spp", spp + 3, out="b.exr") == 0
    assert_same_pictures("a.exr", "b.exr")


@pytest.mark.parametrize("writer", ["checkpoints.save_checkpoint", "pictures.write_exr", "render.write_json"])
def test_further_signals_while_files_are_written_lose_nothing(writer, render, tmp_path, monkeypatch):
    place = f"bokehguide.cli.{writer}"
    write = pkgutil.resolve_name(place)

    def interrupted(*arguments, **keywords):
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
        write(*arguments, **keywords)

    monkeypatch.setattr(place, interrupted)
    every = () if writer == "render.write_json" else ("--checkpoint-every", 1e-6)
    code = render("--spp", 5, "--json", "a.json", *(every or KEEP))
    spp = read_metadata("a.exr")["spp"]
    assert (code, spp) == ((130, 2) if every else (0, 5)), "the summary is written when the render is complete"
    assert kept_spp("a.ckpt", "guided") == json.loads((tmp_path / "a.json").read_text())["spp"] == spp


@pytest.mark.parametrize("place", ["checkpoints.save_checkpoint", "pictures.write_png", "steps.report_step"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_after_the_last_sample_ends_a_complete_render(number, place, render, tmp_path, capsys, monkeypatch):
    place = f"bokehguide.cli.{place}"
    act = pkgutil.resolve_name(place)
    monkeypatch.setattr(place, lambda *arguments: (signal.raise_signal(number), act(*arguments)))
    assert render("--spp", 1, *KEEP) == 0
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join(60)
    error = capsys.readouterr().err
    assert "bokehguide: finishing the render; a second interruption" in error
    assert "interrupted at" not in error and "finishing the step" not in error
    assert kept_spp("a.ckpt", "guided") == 1


@pytest.mark.slow
def test_killed_at_random_moments_it_loses_no_more_than_the_last_interval(render, tmp_path):
    chance, kept = random.Random(0), 0
    for _ in range(KILLS):
        with started(tmp_path, "--resume") as process:
            age = (tmp_path / "a.ckpt").stat().st_mtime_ns if kept else None
            wait_for(process, lambda age=age: (tmp_path / "a.ckpt").exists() and (tmp_path / "a.ckpt").stat().st_mtime_ns != age)
            time.sleep(chance.uniform(0.0, 0.2))
            process.kill()
        assert process.returncode == -signal.SIGKILL
        now = kept_spp("a.ckpt", "guided")  # every step is an interval: what was saved when we looked is still there
        assert now > kept
        kept = now
    assert render("--spp", kept + 2, "--resume") == 0
    assert render("--spp", kept + 2, out="b.exr") == 0
    assert_same_pictures("a.exr", "b.exr")
    assert not list(tmp_path.glob(".*")), "what was half written has been cleared away"


def test_a_second_render_to_the_same_files_is_refused_and_a_killed_one_blocks_none(render, tmp_path, capsys):
    (tmp_path / "link.exr").symlink_to("a.exr")
    with started(tmp_path) as process:
        wait_for(process, (tmp_path / "a.ckpt").exists)
        for out in ("a.exr", "a.EXR", "link.exr"):
            assert render("--spp", 2, "--resume", out=out) == 2
            refused = f"bokehguide: error: {out}: another render is writing this file; wait for its end, or give another --out\n"
            assert capsys.readouterr().err == refused
        assert render("--spp", 2, out="b.exr") == 0 and process.poll() is None
        process.kill()
    spp = kept_spp("a.ckpt", "guided")
    assert render("--spp", spp + 1, "--resume") == 0 and read_metadata("a.exr")["spp"] == spp + 1
    assert not list(tmp_path.glob(".*"))


def test_a_lock_on_a_file_that_its_owner_has_removed_is_taken_again(tmp_path, monkeypatch):
    lock, tried = fcntl.flock, []

    def late(file, operation):
        if not tried:
            (tmp_path / ".a.lock").unlink()
        tried.append(file)
        lock(file, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with sole_writer(tmp_path / "a.exr"):
        assert len(tried) == 2 and (tmp_path / ".a.lock").exists()
        with pytest.raises(BokehguideError, match="another render"), sole_writer(tmp_path / "a.exr"):
            pass
    assert not list(tmp_path.iterdir())


def test_a_file_system_without_locks_refuses_no_render(render, monkeypatch):
    def without(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", without)
    assert render("--spp", 1) == 0


@pytest.mark.slow
def test_there_is_a_picture_after_the_first_step_and_with_each_checkpoint(lamps_file, tmp_path):
    shown = []
    for every in ("0", "1e-6"):
        process = started(tmp_path, "--checkpoint-every", every)
        try:
            wait_for(process, (tmp_path / "a.png").exists)
            shown.append(read_metadata(tmp_path / "a.exr")["spp"])
            assert every == "0" or wait_for(process, lambda: read_metadata(tmp_path / "a.exr")["spp"] > 5) is None
        finally:
            process.kill()
            process.communicate()
        (tmp_path / "a.png").unlink()
    assert shown[0] == 1


def test_a_picture_of_more_samples_stays_until_there_are_as_many(render, tmp_path, monkeypatch):
    """Where a render is started anew by mistake."""
    seen = []
    assert render("--spp", 3, *KEEP) == 0
    refresh = Pictures.refresh
    monkeypatch.setattr(Pictures, "refresh", lambda self, loop: (refresh(self, loop), seen.append(read_metadata("a.exr")["spp"])))
    assert render("--spp", 6, "--checkpoint-every", "1e-6") == 0
    assert seen == [3, 4, 5] and read_metadata("a.exr")["spp"] == 6


def test_pictures_that_cannot_be_shown_end_no_render(render, tmp_path, capsys, monkeypatch):
    written = Pictures.write
    failing = [BokehguideError("a.exr: cannot be written (No space left on device); choose another folder")]

    def full_at_first(self, *arguments):
        if failing:
            raise failing.pop()
        written(self, *arguments)

    monkeypatch.setattr(Pictures, "write", full_at_first)
    assert render("--spp", 3) == 0
    assert capsys.readouterr().err.count("bokehguide: warning: a.exr: cannot be written") == 1
    assert read_metadata("a.exr")["spp"] == 3


def test_a_picture_that_cannot_be_written_at_the_end_loses_no_sample(render, tmp_path, capsys, monkeypatch):
    with monkeypatch.context() as full:

        def fail(self, *_):
            raise BokehguideError("a.exr: cannot be written (No space left on device); choose another folder")

        full.setattr(Pictures, "write", fail)
        assert render("--spp", 3) == 2
    error = capsys.readouterr().err
    assert "bokehguide: error: a.exr: cannot be written" in error
    assert "The samples are kept in a.ckpt; --resume writes the picture" in error
    assert kept_spp("a.ckpt", "guided") == 3
    assert render("--spp", 3, "--resume") == 0
    assert read_metadata("a.exr")["spp"] == 3 and not (tmp_path / "a.ckpt").exists()


@pytest.mark.slow
def test_the_log_goes_on_where_the_checkpoint_was(render, tmp_path):
    """Steps that were logged, but lost, are logged once."""
    for spp, options in ((3, ()), (6, ("--resume",))):
        assert render("--spp", spp, "--logdir", "logs", "--mode", "lis-o", *options, *KEEP) == 0
        if spp == 3:
            shutil.copy("a.ckpt", "kept.ckpt")
        time.sleep(1.1)  # files of events are ordered by the second in their names
    shutil.copy("kept.ckpt", "a.ckpt")
    for _ in range(2):  # the second one has nothing left to do
        assert render("--spp", 9, "--logdir", "logs", "--mode", "lis-o", "--resume", *KEEP) == 0
    log = EventAccumulator(str(tmp_path / "logs/emitters/lis-o"), size_guidance={"images": 0}).Reload()
    seconds = log.Scalars("time/shading")
    assert [event.step for event in seconds] == list(range(1, 10))
    assert [event.value for event in seconds] == sorted(event.value for event in seconds)
    assert [event.step for event in log.Images("render")] == [1, 2, 3, 4, 8, 9]
    texts = [event.tensor_proto.string_val[0].decode() for event in log.Tensors("settings/text_summary")]
    assert "| spp | 9 |" in texts[-1]
