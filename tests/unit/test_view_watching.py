"""`bokehguide view --watch`: a page that follows the file of a render elsewhere."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bokehguide.cli import main
from bokehguide.image import read_layers
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
    (tmp_path / "out.exr").write_bytes(b"\x76\x2f\x31\x01 half")
    rendered(1)
    assert page.until("picture")["spp"] == 1
