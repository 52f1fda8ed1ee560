"""A session of `bokehguide view`, by the messages of its page: every picture is the one of the command line."""

from __future__ import annotations

import base64
import shlex
import threading
import time
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bokehguide.cli import main
from bokehguide.image import Display, read_layers, to_8_bit
from bokehguide.render import PathTracer
from bokehguide.render.film import NO_DEPTH
from bokehguide.scene import FilmSettings, Overrides, load_scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.view.history import LONGEST, History
from bokehguide.view.job import Job, reduced_sizes
from bokehguide.view.pictures import FARTHEST, data_image, depth_image
from bokehguide.view.pixel import BRIGHTEST, DIMMEST, lens_disc
from bokehguide.view.preview import QuickDenoiser, quick_display
from bokehguide.view.session import Session
from bokehguide.view.state import LAYERS, ViewState
from bokehguide.view.workers import AbandonedError, StoppableWorkers
from tests.support.scene_text import BALL, BOX_AND_EMITTER, CAMERA
from tests.support.view_page import opened, served

SPP = 3


@pytest.fixture
def box(tmp_path, monkeypatch) -> str:
    """A scene file in the present folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.toml").write_text(BOX_AND_EMITTER)
    return "box.toml"


@pytest.fixture
def page(box, tmp_path):
    """A page of the box whose picture rests after SPP steps."""
    with served(box, tmp_path, spp=SPP) as server, opened(server) as one:
        yield one


def run(command: str, *options: str) -> None:
    assert main([*shlex.split(command)[1:], *options]) == 0


def png_of(path: str) -> np.ndarray:
    return np.asarray(Image.open(path))


def test_fewer_samples_than_the_picture_has_start_anew(page):
    """At rest and in a render."""
    page.rested()
    page.change(type="set", name="spp", value=SPP - 1)
    command = page.facts["state"]["command"]
    assert page.until("picture", lambda facts: facts["done"])["spp"] == SPP - 1
    run(command, "--out=again.exr")
    np.testing.assert_array_equal(page.rested(), png_of("again.png"))
    page.change(type="set", name="spp", value=1)
    page.send(type="render", on=True)
    assert page.until("note")["note"].endswith(", 1 SPP")


@pytest.mark.parametrize("denoise", [False, True])
def test_the_picture_at_rest_is_that_of_the_command(denoise, page):
    page.change(type="set", name="denoise", value=denoise)
    page.change(type="set", name="f_number", value=0.09)
    command = page.facts["state"]["command"]
    shown = page.rested()
    run(command, "--out=again.exr")
    np.testing.assert_array_equal(shown, png_of("again.png"))


def test_a_click_focuses_on_the_surface_there(page):
    page.change(type="set", name="focus_distance", value=7.0)
    after = page.change(type="focus", x=0.27, y=0.62)["values"]["focus_distance"]
    expected = load_scene("box.toml", Overrides(focus_at=(0.27, 0.62))).camera.focus_distance
    assert after == expected == pytest.approx(3.0, abs=0.2)
    page.send(type="focus", x=0.99, y=0.01)
    assert "the middle of the lens meets nothing but background there" in page.until("failure")["failure"]


def test_every_change_of_the_lens_changes_the_picture(page):
    seen = [page.rested()]
    for name, value in [
        ("f_number", 0.2),
        ("focus_distance", 7.0),
        ("fov", 25.0),
        ("blades", 5),
        ("rotation", 20.0),
        ("ratio", 2.0),
    ]:
        page.change(type="set", name=name, value=value)
        seen.append(page.rested())
    page.change(type="move", kind="orbit", x=0.1, y=0.05)
    seen.append(page.rested())
    assert all(not np.array_equal(one, other) for number, one in enumerate(seen) for other in seen[:number])


def test_a_reset_returns_to_the_first_picture(page):
    first = page.rested()
    page.change(type="set", name="f_number", value=0.2)
    page.change(type="move", kind="walk", x=0.1, y=0.0)
    page.rested()
    page.change(type="reset")
    np.testing.assert_array_equal(page.rested(), first)


def test_changes_are_undone_one_by_one(page):
    """The moves of a drag are one change; a layer is none."""
    first = page.rested()
    values = page.facts["state"]["values"]
    assert page.facts["state"]["changes"] == 0
    page.send(type="undo")
    assert "nothing has been changed" in page.until("failure")["failure"]
    focused = page.change(type="set", name="focus_distance", value=7.0)["values"]
    for _ in range(4):
        page.change(type="move", kind="orbit", x=0.01, y=0.0)
    page.change(type="set", name="layer", value="depth")
    assert page.facts["state"]["changes"] == 2
    assert page.change(type="undo")["values"] == {**focused, "layer": "depth"}
    page.change(type="set", name="layer", value="picture")
    assert page.change(type="undo")["values"] == values and page.facts["state"]["changes"] == 0
    np.testing.assert_array_equal(page.rested(), first)


def test_a_pause_begins_another_change(monkeypatch):
    history, state = History(), ViewState(Overrides())
    for number in range(3):
        monkeypatch.setattr(time, "monotonic", lambda number=number: 10.0 * number)
        history.add(replace(state, seed=number), replace(state, seed=number + 1), "move")
    assert len(history) == 3 and history.undone(state).seed == 2
    for number in range(2 * LONGEST):
        history.add(replace(state, seed=number), replace(state, seed=number + 1), number)
    assert len(history) == LONGEST


def test_the_display_changes_without_new_samples(page):
    page.rested()
    seconds = page.facts["picture"]["seconds"]
    for name, value in [("exposure", 2.0), ("view", "srgb"), ("layer", "depth"), ("layer", "picture")]:
        revision = page.change(type="set", name=name, value=value)["revision"]
        facts = page.until("picture", lambda facts: facts["revision"] == revision)  # noqa: B023 - used at once
        assert (facts["seconds"], facts["spp"]) == (seconds, SPP), name


def test_denoised_pictures_have_samples_of_their_own(page):
    """The command line makes the same picture, without reuse of samples among pixels."""
    page.rested()
    page.change(type="set", name="denoise", value=True)
    page.rested()
    page.send(type="save_picture")
    page.until("note")
    saved, header = read_layers("box-view.exr")
    run(header["command"], "--out=again.exr")
    assert "--denoise" in header["command"]
    again, _ = read_layers("again.exr")
    assert saved.keys() == again.keys() and "denoised" in saved
    for name in saved:
        np.testing.assert_array_equal(saved[name], again[name], err_msg=name)


def test_layers_are_pictures_of_their_own(page):
    page.rested()
    images = {}
    for layer in LAYERS[1:]:
        revision = page.change(type="set", name="layer", value=layer)["revision"]
        page.until("picture", lambda facts: facts["revision"] == revision)  # noqa: B023
        images[layer] = page.image
    run(page.facts["state"]["command"], "--out=again.exr")
    layers, _ = read_layers("again.exr")
    for layer in ("depth", "normal", "albedo", "variance"):  # whatever the mode has learned
        np.testing.assert_array_equal(images[layer], data_image(layer, layers))
    assert len({image.tobytes() for image in images.values()}) == len(images)


def test_a_saved_picture_is_what_the_command_renders(page):
    page.change(type="set", name="f_number", value=0.1)
    page.rested()
    page.send(type="save_picture")
    assert page.until("note")["note"] == f"wrote box-view.exr and box-view.png, {SPP} SPP"
    saved, header = read_layers("box-view.exr")
    run(header["command"], "--out=again.exr")
    again, other = read_layers("again.exr")
    assert saved.keys() == again.keys()
    for name in saved:
        np.testing.assert_array_equal(saved[name], again[name], err_msg=name)
    np.testing.assert_array_equal(png_of("box-view.png"), png_of("again.png"))
    assert {key: header[key] for key in ("mode", "spp", "exposure", "display_view")} == {
        key: other[key] for key in ("mode", "spp", "exposure", "display_view")
    }
    page.send(type="save_picture")
    assert "box-view-2.exr" in page.until("note")["note"]


def test_a_saved_scene_renders_to_the_picture(page):
    page.change(type="focus", x=0.27, y=0.62)
    page.change(type="move", kind="look", x=0.05, y=0.0)
    shown = page.rested()
    page.send(type="save_scene")
    page.until("note", lambda facts: facts["note"].startswith("wrote box-view.toml"))
    run(Path("box-view.toml").read_text().splitlines()[0].removeprefix("# "), "--out=again.exr")
    np.testing.assert_array_equal(shown, png_of("again.png"))


def test_a_render_stops_and_goes_on_to_the_picture_of_the_command(box, tmp_path):
    with served(box, tmp_path, mode="uniform", spp=1 << 20) as server, opened(server) as page:
        page.until("picture", lambda facts: facts["spp"] == 32 and facts["done"])
        page.send(type="render", on=True)
        page.until("picture", lambda facts: facts["spp"] > 32)
        page.send(type="set", name="f_number", value=3.0)
        assert "a render is running" in page.until("failure")["failure"]
        page.send(type="render", on=False)
        page.until("state", lambda facts: not facts["rendering"])
        page.send(type="hover", x=0.5, y=0.5)
        spp = int(page.until("pixel")["sample_count"]) + 5
        page.change(type="set", name="spp", value=spp)
        page.send(type="render", on=True)
        assert page.until("note")["note"] == f"wrote box-view.exr and box-view.png, {spp} SPP"
        assert not page.until("state")["rendering"]
        run(page.facts["state"]["command"], "--out=again.exr")
        saved, again = (read_layers(path)[0] for path in ("box-view.exr", "again.exr"))
        for name in again:
            np.testing.assert_array_equal(saved[name], again[name], err_msg=name)


def test_a_render_pauses_while_no_page_is_open(box, tmp_path):
    with served(box, tmp_path, mode="uniform", spp=1 << 20) as server:
        with opened(server) as page:
            page.send(type="render", on=True)
            page.until("picture", lambda facts: facts["spp"] > 8)
        renderer = server.shown.renderer
        deadline = time.monotonic() + 60.0
        while renderer.ask(lambda job: job.loop.step_number).result(60) != (spp := step_after(renderer, 0.5)):
            assert time.monotonic() < deadline, "the render goes on without a page"
        with opened(server) as page:
            assert "the render goes on" in page.until("note")["note"] and page.facts["state"]["rendering"]
            assert page.until("picture", lambda facts: facts["spp"] > spp)["rendering"]
            page.send(type="render", on=False)
            page.until("state", lambda facts: not facts["rendering"])


def test_a_stopped_render_rests_and_keeps_its_samples(box, tmp_path):
    """Before the samples of a preview, too, and while no page is open; another picture has nothing to go on with."""
    with served(box, tmp_path, overrides=Overrides(width=320, height=200), spp=1 << 20) as server:
        with opened(server) as page:
            page.send(type="render", on=True)
            page.until("picture", lambda facts: facts["spp"] >= 2)
            page.send(type="render", on=False)
            assert page.until("state", lambda facts: not facts["rendering"])["paused"]
            facts = page.until("picture", lambda facts: facts["exact"])
            assert facts["spp"] < 32 and facts["limit"] == 1 << 20
        step = step_after(server.shown.renderer, 1.0)
        assert step == facts["spp"]
        with opened(server) as page:
            assert page.facts["state"]["paused"]
            page.change(type="set", name="spp", value=step + 1)
            page.send(type="render", on=True)
            assert page.until("note", lambda facts: facts["note"].startswith("wrote"))["note"].endswith(f", {step + 1} SPP")
            page.change(type="set", name="spp", value=1 << 20)
            page.send(type="render", on=True)
            page.until("picture", lambda facts: facts["rendering"])
            page.send(type="render", on=False)
            page.until("state", lambda facts: facts["paused"])
            assert not page.change(type="set", name="f_number", value=3.0)["paused"]


def step_after(renderer, seconds: float) -> int:
    """The number of steps some time later."""
    time.sleep(seconds)
    return renderer.ask(lambda job: job.loop.step_number).result(60)


def test_learned_state_stays_when_the_lens_or_the_camera_changes(box, tmp_path):
    """The first step at full size draws from what the picture before has learned, with other random numbers."""
    with served(box, tmp_path, spp=1) as server, opened(server) as page:
        renderer = server.shown.renderer
        page.rested()
        first = renderer.ask(lambda job: job.loop).result(60)
        learned = [first.settings.seed]
        for request in (
            {"type": "set", "name": "f_number", "value": 0.2},
            {"type": "move", "kind": "orbit", "x": 0.01, "y": 0.0},
        ):
            found = []
            make = type(first).inherit

            def inherit(loop, state, make=make, found=found):
                make(loop, state)
                found.append((loop.settings.seed, bool(loop.mode.lights.sampler.probability.any()), loop.mode.lens.beta.unique()))

            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(type(first), "inherit", inherit)
                page.change(**request)
                page.rested()
            [(seed, lights, beta)] = found
            assert lights and len(beta) > 1
            learned.append(seed)
        assert len(set(learned)) == 3
        assert renderer.ask(lambda job: job.exact and job.loop.settings.seed).result(60) == 0


def test_another_environment_or_mode_begins_without_learned_state(box, tmp_path, monkeypatch):
    monkeypatch.setattr(RenderLoop, "inherit", lambda *_: pytest.fail("inherited"))
    with served(box, tmp_path, spp=1) as server, opened(server) as page:
        page.rested()
        for name, value in (("environment_rotation", 30.0), ("mode", "lis-o"), ("mode", "uniform")):
            page.change(type="set", name=name, value=value)
            page.rested()
            assert server.shown.renderer.exact


def test_a_picture_that_cannot_be_written_keeps_the_samples(page, tmp_path, monkeypatch):
    page.rested()
    monkeypatch.setattr(
        "bokehguide.view.saving.free_paths", lambda *_: [tmp_path / "none" / "a.exr", tmp_path / "none" / "a.png"]
    )
    page.send(type="save_picture")
    assert "cannot be written" in page.until("failure")["failure"]
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    page.send(type="save_picture")
    assert f"{SPP} SPP" in page.until("note")["note"]


def test_the_values_of_a_pixel_are_those_of_the_file(page):
    page.rested()
    page.send(type="hover", x=0.3, y=0.6)
    pixel = page.until("pixel")
    run(page.facts["state"]["command"], "--out=again.exr")
    layers, _ = read_layers("again.exr")
    column, row = pixel["pixel"]
    assert (column, row) == (int(0.3 * 32), int(0.6 * 20))
    for name in ("beauty", "normal", "albedo", "variance", "depth"):
        np.testing.assert_array_equal(np.float32(pixel[name]), layers[name][row, column], err_msg=name)
    assert pixel["lens"]["draws"] and all(x * x + y * y <= 1.0 for x, y in pixel["lens"]["draws"])


@pytest.mark.parametrize("mode", ["uniform", "lis-o", "guided", "area-restir"])
def test_the_density_on_the_lens_is_that_of_the_draws(mode, box):
    """Its mean over the lens is 1, relative to a uniform lens, and most draws fall where it is high."""
    scene = load_scene(box)
    with RenderLoop(scene, RenderSettings(mode, threads=1)) as loop:
        for _ in range(4):
            loop.step()
        brightest = int(loop.film.radiance().sum(-1).argmax())
        disc = lens_disc(loop, brightest)
    cells = np.frombuffer(base64.b64decode(disc["cells"]), np.uint8).reshape(disc["grid"], disc["grid"])
    density = DIMMEST * (BRIGHTEST / DIMMEST) ** ((cells[cells > 0] - 1.0) / 254.0)
    # Gaussians of the paper reach beyond the lens.
    assert density.mean() == pytest.approx(1.0, abs=0.12) or (mode == "lis-o" and 0.5 < density.mean() < 1.0)
    assert (cells > 0).mean() == pytest.approx(np.pi / 4.0, abs=0.02)
    assert disc["highest"] == pytest.approx(density.max(), rel=0.02)
    guided = mode in ("lis-o", "guided")
    assert (density.max() > 2.0) == guided
    if guided:
        half = disc["grid"] / 2.0
        at = np.array([cells[int(half - y * half), int(half + x * half)] for x, y in disc["draws"]])
        assert (at > np.median(cells[cells > 0])).mean() > 0.6


def test_the_plane_of_focus_is_marked_where_the_surface_is_sharp(page):
    page.change(type="focus", x=0.27, y=0.62)
    page.send(type="mark", on=True)
    assert page.until("marker")["on"]
    page.send(type="mark", on=False)
    assert not page.until("marker")["on"]


def test_a_first_picture_is_never_abandoned(box, tmp_path):
    """A drag sends changes faster than pictures follow; they follow all the same."""
    with served(box, tmp_path, spp=SPP) as server, opened(server) as page:
        ended = threading.Event()

        def drag():
            while not ended.wait(0.004):
                page.send(type="move", kind="orbit", x=0.001, y=0.0)

        thread = threading.Thread(target=drag)
        thread.start()
        try:
            revisions = {page.until("picture")["revision"] for _ in range(10)}
        finally:
            ended.set()
            thread.join()
        assert len(revisions) > 3


def test_sizes_double_up_to_the_full_one():
    sizes = [(film.width, film.height) for film in reduced_sizes(FilmSettings(640, 360, max_depth=2))]
    assert sizes == [(80, 45), (160, 90), (320, 180), (640, 360)]
    assert [film.width for film in reduced_sizes(FilmSettings(32, 20))] == [32]
    assert [film.width for film in reduced_sizes(FilmSettings(24000, 1))] == [12000, 24000]
    assert all(film.max_depth == 2 for film in reduced_sizes(FilmSettings(640, 360, max_depth=2)))


def test_small_batches_change_no_bit(box):
    scene = load_scene(box, Overrides(width=160, height=100))
    workers, state = StoppableWorkers(2), ViewState(Overrides())
    job = Job(scene, state, PathTracer(scene), workers, pixels=1e6)
    with workers, RenderLoop(scene, RenderSettings(threads=1)) as loop:
        for _ in range(2):
            job.advance()
            loop.step()
        assert len(job.loop.batches.spans(160 * 100)) > len(loop.batches.spans(160 * 100)) == 1
        assert (job.loop.film.radiance() == loop.film.radiance()).all()


def test_stopped_workers_begin_no_item():
    with StoppableWorkers(1) as workers:
        assert workers.map(lambda item: 2 * item, [1, 2]) == [2, 4]
        workers.stop.set()
        with pytest.raises(AbandonedError):
            workers.map(lambda item: 2 * item, [1, 2])


@pytest.mark.parametrize("view", ["photo", "aces", "srgb"])
def test_the_quick_view_is_within_a_few_levels(view):
    rng = np.random.default_rng(1)
    radiance = (np.exp2(rng.uniform(-9.0, 8.0, (60, 80, 1))) * rng.uniform(0.1, 1.0, (60, 80, 3))).astype(np.float32)
    radiance[0, 0] = np.nan
    exact = to_8_bit(Display(0.5, view).show(radiance)).astype(int)
    quick = quick_display(radiance, 0.5, view).astype(int)
    assert np.abs(exact - quick).max() <= (0 if view == "srgb" else 4) and np.abs(exact - quick).mean() < 0.3


def test_the_quick_denoiser_lowers_the_error():
    pytest.importorskip("mitsuba_oidn")
    rng = np.random.default_rng(2)
    truth = np.linspace(0.2, 1.0, 96)[None, :, None] * np.ones((64, 1, 3))
    noisy = (truth * rng.gamma(2.0, 0.5, truth.shape)).astype(np.float32)
    clean = QuickDenoiser()(noisy)
    assert np.abs(clean - truth).mean() < 0.25 * np.abs(noisy - truth).mean()


def test_a_render_that_has_all_of_its_samples_writes_its_files_at_once(page):
    page.rested()
    page.send(type="render", on=True)
    assert page.until("note")["note"] == f"wrote box-view.exr and box-view.png, {SPP} SPP"


def test_a_picture_of_each_size_is_shown(box, tmp_path, monkeypatch):
    """From the first one on, each is twice as wide as the one before."""
    told, original = [], Session.shown
    monkeypatch.setattr(Session, "shown", lambda self, facts, shown: (told.append(facts), original(self, facts, shown)))
    with served(box, tmp_path, overrides=Overrides(width=640, height=400), spp=1) as server, opened(server) as page:
        page.rested()
    assert [round(facts["reduction"]) for facts in told] == [8, 4, 2, 1, 1]  # the last one is exact


def test_a_browser_that_connects_later_sees_the_latest_picture(box, tmp_path):
    with served(box, tmp_path, spp=SPP) as server, opened(server) as first:
        shown = first.rested()
        with opened(server) as second:
            assert second.facts["picture"]["exact"]
            np.testing.assert_array_equal(second.image, shown)


def test_the_page_tells_the_warnings_of_its_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("dark.toml").write_text(CAMERA + BALL)
    with served("dark.toml", tmp_path, spp=1) as server, opened(server) as page:
        assert page.facts["note"]["note"].startswith("warning: nothing shines")


def test_pictures_of_earlier_states_are_freed(box, tmp_path):
    with served(box, tmp_path, spp=1) as server, opened(server) as page:
        jobs = []
        for number in range(12):
            page.change(type="set", name="focus_distance", value=2.0 + 0.1 * number)
            page.until("picture", lambda facts: facts["revision"] == page.facts["state"]["revision"])
            jobs.append(server.shown.renderer.ask(weakref.ref).result(60))
        page.rested()
        assert len({id(job) for job in jobs}) == 12
        assert sum(job() is not None for job in jobs) <= 2


def test_nothing_keeps_a_picture_when_nobody_watches(box, tmp_path):
    """Also where the last step was abandoned."""
    with served(box, tmp_path, overrides=Overrides(width=640, height=400), spp=SPP) as server:
        with opened(server) as page:
            page.until("picture")
            job = server.shown.renderer.ask(weakref.ref).result(60)
        deadline = time.monotonic() + 60.0
        while job() is not None and time.monotonic() < deadline:
            time.sleep(0.05)
        assert job() is None


@pytest.mark.parametrize("depth", [[[2.0, 4.0], [8.0, NO_DEPTH]], [[2.0, 2.0], [2.0, NO_DEPTH]], [[NO_DEPTH]]])
def test_the_picture_of_the_depth_has_contrast(depth):
    """It spans the surfaces, whatever their distance."""
    near, scaled = depth_image(np.array(depth)), depth_image(100.0 * np.array(depth))
    np.testing.assert_allclose(near, scaled, rtol=1e-6)
    met = np.array(depth) < NO_DEPTH
    assert not near[~met].any() and (not met.any() or near.max() == 1.0)
    if len(np.unique(depth)) > 2:
        np.testing.assert_allclose(near, [[1.0, FARTHEST + (1.0 - FARTHEST) / 3.0], [FARTHEST, 0.0]])
