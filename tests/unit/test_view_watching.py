"""`bokehguide view --watch`: a page that follows the file of a render elsewhere."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bokehguide.cli import main
from bokehguide.image import read_layers, write_exr
from bokehguide.scene import load_scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.view.server import ViewServer
from bokehguide.view.watching import WatchedFile
from tests.support.scene_text import BOX_AND_EMITTER
from tests.support.view_page import opened


@pytest.fixture
def rendered(tmp_path, monkeypatch):
    """A function that renders some SPP into `out.exr`, as another process would replace it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.toml").write_text(BOX_AND_EMITTER)

    def render(spp: int) -> None:
        assert main(["render", "box.toml", f"--spp={spp}", "--denoise", f"--out=other-{spp}.exr"]) == 0
        shutil.copy(f"other-{spp}.exr", "next.exr")
        Path("next.exr").replace("out.exr")

    return render


@pytest.fixture
def page(tmp_path):
    server = ViewServer(WatchedFile(tmp_path / "out.exr"))
    server.start()
    with opened(server) as one:
        one.server = server
        yield one
    server.close()


def test_it_waits_for_the_file_and_follows_it(rendered, page):
    assert page.facts["hello"]["follows"] and "waiting for out.exr" in page.facts["note"]["note"]
    for spp in (1, 3):
        rendered(spp)
        facts = page.until("picture", lambda facts: facts["spp"] == spp)  # noqa: B023
        np.testing.assert_array_equal(page.image, np.asarray(Image.open(f"other-{spp}.png")))
        _, header = read_layers("out.exr")
        assert page.facts["state"]["command"] == header["command"] and facts["exposure"] == header["exposure"]


def test_its_display_can_be_set_and_its_camera_cannot(rendered, page):
    rendered(2)
    page.until("picture")
    before = page.image
    for name, value in [("exposure", 3.0), ("layer", "depth"), ("layer", "picture"), ("denoise", False), ("view", "srgb")]:
        page.send(type="set", name=name, value=value)
        page.until("picture")
        assert not np.array_equal(page.image, before), name
        before = page.image
    page.send(type="set", name="f_number", value=2.0)
    assert "cannot be set here" in page.until("failure")["failure"]
    page.send(type="set", name="view", value="fog")
    assert "choose one of photo, aces, srgb" in page.until("failure")["failure"]


def test_a_pixel_has_the_values_of_the_file(rendered, page):
    rendered(2)
    page.until("picture")
    page.send(type="hover", x=0.3, y=0.6)
    pixel = page.until("pixel")
    layers, _ = read_layers("out.exr")
    column, row = pixel["pixel"]
    np.testing.assert_array_equal(np.float32(pixel["beauty"]), layers["beauty"][row, column])
    page.send(type="hover", x="a", y=None)
    page.send(type="set", name="exposure", value=1.0)
    assert page.until("state")["values"]["exposure"] == 1.0


def test_a_damaged_file_is_read_when_it_is_whole(rendered, page, tmp_path):
    """What is wrong with it is told, to browsers that connect later, too."""
    (tmp_path / "out.exr").write_bytes(b"\x76\x2f\x31\x01 half")
    assert "out.exr" in page.until("failure")["failure"]
    with opened(page.server) as other:
        assert other.facts["failure"] == page.facts["failure"]
    rendered(1)
    assert page.until("picture")["spp"] == 1


def test_a_file_that_disappears_is_told_and_its_picture_stays(rendered, page, tmp_path):
    rendered(2)
    page.until("picture")
    (tmp_path / "out.exr").unlink()
    assert page.until("failure")["failure"] == "out.exr: the file is gone; the page keeps its last picture"
    with opened(page.server) as other:
        assert other.facts["picture"]["spp"] == 2


def test_the_figures_are_those_of_the_render(rendered, page, tmp_path):
    """The curve has an entry for each file with an error; one sample has no error."""
    errors = {}
    for spp in (1, 2, 4):
        rendered(spp)
        facts = page.until("picture", lambda facts: facts["spp"] == spp)  # noqa: B023
        errors[spp] = facts["error"]
        assert facts["limit"] == spp and 0.0 <= facts["age"] < 60.0
    assert errors[1] is None and facts["curve"] == [[2, errors[2]], [4, errors[4]]]
    with RenderLoop(load_scene("box.toml"), RenderSettings(spp=4, denoise=True)) as loop:
        for _ in range(4):
            loop.step()
    assert errors[4] == pytest.approx(loop.film.relative_noise(), rel=1e-5)
    layers, _ = read_layers("out.exr")
    write_exr("next.exr", {"beauty": layers["beauty"]}, metadata={"settings": '{"spp": 100}', "spp": 5})
    Path("next.exr").replace("out.exr")
    facts = page.until("picture", lambda facts: facts["limit"] == 100)
    assert facts["curve"] == [] and not facts["done"] and facts["error"] is None


def test_an_exr_of_another_program_needs_no_header(page, tmp_path):
    write_exr(tmp_path / "next.exr", {"beauty": np.full((4, 6, 3), 0.5, np.float32)}, metadata={"spp": "many", "settings": "[]"})
    (tmp_path / "next.exr").replace(tmp_path / "out.exr")
    facts = page.until("picture")
    assert (facts["width"], facts["height"], facts["spp"], facts["limit"]) == (6, 4, 0, 0)
    assert not page.facts["state"]["values"]["denoise"]


def test_an_exr_without_a_picture_is_told(page, tmp_path):
    write_exr(tmp_path / "next.exr", {"depth": np.ones((4, 6), np.float32)})
    (tmp_path / "next.exr").replace(tmp_path / "out.exr")
    assert "no channels R, G and B" in page.until("failure")["failure"]


def test_a_file_that_follows_does_not_greet_again(rendered, page):
    rendered(1)
    page.until("picture")
    page.facts.pop("hello")
    rendered(2)
    page.until("picture", lambda facts: facts["spp"] == 2)
    assert "hello" not in page.facts
