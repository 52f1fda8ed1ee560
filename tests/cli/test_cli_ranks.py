"""`torchrun … -m bokehguide render`: several processes, one picture."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bokehguide.image import read_exr, write_exr

TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone")


def torchrun(folder, count, *arguments, restarts=0):
    """Start a job of `count` ranks; its output goes to `job.log`."""
    job = ("--nproc-per-node", count, "--max-restarts", restarts, "-m", "bokehguide", "render", *arguments)
    with (folder / "job.log").open("w") as log:
        return subprocess.Popen([*TORCHRUN, *map(str, job)], cwd=folder, stdout=log, stderr=log)


ENDS_WITH_ITS_THREADS = """
import sys
from pathlib import Path
from bokehguide.cli import main
code = main(sys.argv[1:])
names = {path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")}
sys.exit(code or any("gloo" in name for name in names))
"""


def assert_same(path, other):
    """Equal but for the order in which sums were made."""
    one, two = read_exr(path), read_exr(other)
    assert one.keys() == two.keys()
    for name in one:
        np.testing.assert_allclose(two[name], one[name], rtol=1e-5, atol=1e-5, err_msg=name)


def logged_blend_weights(folder):
    """The picture of β after step 16 in the only log in `folder`, as a PNG; None without a log."""
    found = list(folder.glob("logs/*/*"))
    if not found:
        return None
    log = EventAccumulator(str(found[0]), size_guidance={"images": 0}).Reload()
    return next(image.encoded_image_string for image in log.Images("beta") if image.step == 16)


OPTIONS = {
    "uniform": (2, ("--mode", "uniform", "--cryptomatte")),
    "guided": (2, ("--mode", "guided", "--logdir", "logs", "--reference", "reference.exr")),
    "lis-b": (3, ("--mode", "lis-b", "--crop", "3,2,25,17", "--target-noise", 0.2, "--logdir", "logs")),
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="names of threads are read from /proc")
def test_no_thread_of_a_job_outlives_the_render(lamps_file, tmp_path):
    (tmp_path / "end.py").write_text(ENDS_WITH_ITS_THREADS)
    options = ("--mode", "lis-b", "--spp", "2", "--size", "32x20", "--out", "out.exr")  # a mode with an optimiser
    job = subprocess.run(
        [*TORCHRUN, "--nproc-per-node", "2", "end.py", "render", str(lamps_file), *options],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert job.returncode == 0, job.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", OPTIONS)
def test_the_picture_of_several_is_that_of_one(name, bokehguide, lamps_file, tmp_path):
    count, options = OPTIONS[name]
    reference = np.full((20, 32, 3), 0.1, np.float32)
    reference[3, 4] = -0.1
    write_exr(tmp_path / "reference.exr", {"beauty": reference})
    options = (lamps_file, *options, "--threads", 1)
    assert bokehguide("render", *options, "--spp", 24, "--out", "one.exr").returncode == 0
    blend_weights = logged_blend_weights(tmp_path)
    job = torchrun(tmp_path, count, *options, "--spp", 18, "--out", "some.exr", "--checkpoint-every", 60)
    assert job.wait(120) == 0, (tmp_path / "job.log").read_text()
    assert logged_blend_weights(tmp_path) == blend_weights
    resumed = bokehguide("render", *options, "--spp", 24, "--out", "some.exr", "--resume")  # by one alone
    assert resumed.returncode == 0 and "resuming some.ckpt at 18 SPP" in resumed.stderr, resumed.stderr
    assert_same(tmp_path / "one.exr", tmp_path / "some.exr")
    log = (tmp_path / "job.log").read_text()
    assert log.count("wrote some.exr") == 1 and log.count("18/18") == 1, "one rank speaks"
    assert log.count("3 negative values") == ("--reference" in options)


@pytest.mark.slow
def test_area_restir_is_refused(lamps_file, tmp_path):
    job = torchrun(tmp_path, 2, lamps_file, "--mode", "area-restir", "--spp", 1)
    assert job.wait(120) != 0
    assert "mode: area-restir reuses samples of the whole frame; render it in one process" in (tmp_path / "job.log").read_text()


def ranks_of(job):
    """Process numbers of a job's ranks."""
    return [int(child) for child in Path(f"/proc/{job.pid}/task/{job.pid}/children").read_text().split()]


def log_of_restart(job, folder, file):
    """Kill the second rank once `file` exists. Returns the log of the job, which goes on to its end."""
    deadline = time.monotonic() + 60.0
    while not (folder / file).exists():
        assert job.poll() is None and time.monotonic() < deadline, (folder / "job.log").read_text()
        time.sleep(0.01)
    os.kill(ranks_of(job)[1], signal.SIGKILL)
    assert job.wait(120) == 0, (folder / "job.log").read_text()
    log = (folder / "job.log").read_text()
    assert "another rank has ended" in log or "signal SIGTERM" in log
    return log


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the ranks in /proc")
def test_a_rank_that_dies_is_told_of_and_the_restart_goes_on(lamps_file, bokehguide, tmp_path):
    options = (lamps_file, "--threads", 1, "--size", "320x180", "--spp", 24, "--checkpoint-every", 0.01)
    job = torchrun(tmp_path, 2, *options, "--out", "some.exr", restarts=1)
    log = log_of_restart(job, tmp_path, "some.ckpt")
    assert "resuming some.ckpt" in log
    assert bokehguide("render", *options, "--out", "one.exr").returncode == 0
    assert_same(tmp_path / "one.exr", tmp_path / "some.exr")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the ranks in /proc")
def test_a_restart_before_the_first_save_leaves_the_checkpoint_of_another_render(lamps_file, bokehguide, tmp_path):
    options = (lamps_file, "--threads", 1, "--size", "320x180", "--out", "some.exr", "--checkpoint-every", 60)
    assert bokehguide("render", *options, "--spp", 1, "--seed", 4).returncode == 0
    kept = (tmp_path / "some.ckpt").read_bytes()
    (tmp_path / "some.exr").unlink()
    job = torchrun(tmp_path, 2, *options, "--spp", 24, "--seed", 9, restarts=1)
    log = log_of_restart(job, tmp_path, "some.exr")
    assert log.count("some.ckpt was of another render and is some-2.ckpt now") == 1
    assert (tmp_path / "some-2.ckpt").read_bytes() == kept
