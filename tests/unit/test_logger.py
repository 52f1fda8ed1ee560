"""TensorBoard logs, read back from the files."""

import resource
import threading

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bokehguide.metrics import mape, relmse
from bokehguide.scene import load_scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.train.logger import RenderLogger

SCALARS = {
    *("guide/gaussians", "speed/samples_per_second"),
    *(f"time/{phase}" for phase in ("tracing_rays", "shading", "guiding", "learning", "output")),
}


def render(logdir, lamps_file, mode, spp, reference=None):
    """Log a render and give its loop and the errors of each step."""
    scene, settings = load_scene(str(lamps_file)), RenderSettings(mode=mode, spp=spp, threads=1)
    loop, logger, history = RenderLoop(scene, settings), RenderLogger(logdir, scene, settings), []
    for _ in range(spp):
        stats, errors = loop.step(), {}
        if reference is not None:
            radiance = loop.film.radiance()
            errors = {"mape": mape(radiance, reference), "relmse": relmse(radiance, reference)}
        logger.log(loop, stats, errors, loop.film)
        history.append(errors)
    logger.finish(loop, spp, loop.film)
    return loop, history


def read(folder):
    accumulator = EventAccumulator(str(folder), size_guidance=dict.fromkeys(("scalars", "images", "tensors"), 0))
    return accumulator.Reload()


def curve(log, tag):
    events = log.Scalars(tag)
    return [event.step for event in events], [event.value for event in events]


def test_scalars_of_every_step(tmp_path, lamps_file):
    reference = torch.full((20, 32, 3), 0.1)
    _, history = render(tmp_path / "logs", lamps_file, "lis-o", 6, reference)
    log = read(tmp_path / "logs/emitters/lis-o")
    tags = set(log.Tags()["scalars"])
    assert SCALARS | {"error/mape", "error/relmse", "guide/kl", "guide/beta", "guide/outside_share"} == tags
    for name in ("mape", "relmse"):
        steps, values = curve(log, f"error/{name}")
        assert steps == [1, 2, 3, 4, 5, 6]
        np.testing.assert_allclose(values, [errors[name] for errors in history], rtol=1e-6)
    steps, seconds = curve(log, "time/shading")
    assert steps == [1, 2, 3, 4, 5, 6] and seconds == sorted(seconds)


def test_without_a_reference_the_noise_is_estimated(tmp_path, lamps_file):
    loop, _ = render(tmp_path / "logs", lamps_file, "uniform", 4)
    log = read(tmp_path / "logs/emitters/uniform")
    assert set(log.Tags()["scalars"]) >= SCALARS
    assert not {"error/mape", "guide/kl"} & set(log.Tags()["scalars"])
    steps, noise = curve(log, "error/relative_noise")
    assert steps == [2, 3, 4] and min(noise) > 0.0  # a single step has no estimate
    assert noise[-1] == pytest.approx(loop.film.relative_noise(), rel=1e-6)


@pytest.mark.parametrize(("spp", "expected"), [(6, [1, 2, 4, 6]), (4, [1, 2, 4])])
def test_pictures_at_powers_of_two_and_at_the_end(spp, expected, tmp_path, lamps_file):
    render(tmp_path / "logs", lamps_file, "lis", spp)
    log = read(tmp_path / "logs/emitters/lis")
    assert {"render", "beta", "record", "highlights"} == set(log.Tags()["images"])
    for tag in log.Tags()["images"]:
        assert [event.step for event in log.Images(tag)] == expected
    for tag in ("render", "beta"):
        assert {(event.width, event.height) for event in log.Images(tag)} == {(32, 20)}


def test_settings_as_text(tmp_path, lamps_file):
    render(tmp_path / "logs", lamps_file, "lis-b", 1)
    log = read(tmp_path / "logs/emitters/lis-b")
    text = log.Tensors("settings/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "| mode | lis-b |" in text and "| scene | emitters |" in text and '"aperture_radius": 0.5' in text


def test_a_second_run_replaces_the_first_and_other_modes_stay(tmp_path, lamps_file):
    render(tmp_path / "logs", lamps_file, "lis", 2)
    render(tmp_path / "logs", lamps_file, "uniform", 3)
    keep = tmp_path / "logs/emitters/uniform/notes.txt"
    keep.write_text("mine")
    render(tmp_path / "logs", lamps_file, "uniform", 2)
    assert curve(read(tmp_path / "logs/emitters/uniform"), "guide/gaussians")[0] == [1, 2]
    assert curve(read(tmp_path / "logs/emitters/lis"), "guide/gaussians")[0] == [1, 2]
    assert keep.read_text() == "mine"


@pytest.mark.parametrize("room", [0, 100, 3000])
def test_a_log_that_finds_a_full_disk_ends_with_one_warning(room, tmp_path, lamps_file, caplog, capfd):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    hook = threading.excepthook
    try:
        loop, history = render(tmp_path / "logs", lamps_file, "lis-o", 9)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert loop.step_number == len(history) == 9 and threading.excepthook is hook
    assert capfd.readouterr().err == ""
    told = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    folder = tmp_path / "logs/emitters/lis-o"
    assert told == [f"{folder}: the log ends here (File too large); the render goes on"]


def test_other_threads_still_report_their_exceptions(tmp_path, lamps_file, monkeypatch):
    seen = []
    monkeypatch.setattr(threading, "excepthook", lambda failure: seen.append(failure.exc_type))
    loop = RenderLoop(load_scene(str(lamps_file)), RenderSettings("uniform", threads=1))
    RenderLogger(tmp_path, loop.scene, loop.settings)
    thread = threading.Thread(target=lambda: 1 // 0)
    thread.start()
    thread.join()
    assert seen == [ZeroDivisionError]
