"""`bokehguide.view(scene)`: the page in a notebook."""

from __future__ import annotations

from urllib.request import urlopen

import numpy as np
import pytest

import bokehguide
from tests.support.scenes import emitters
from tests.support.view_page import opened


def test_a_page_shows_itself_in_a_cell_and_follows_its_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with bokehguide.view("daylight", "uniform", 1, size=(32, 18), focus_distance=2.5) as page:
        assert f'<iframe src="{page.address}"' in page._repr_html_() and page.address in repr(page)
        with urlopen(page.address, timeout=30) as answer:
            assert b"bokehguide view" in answer.read()
        assert "--size=32x18 --focus-distance=2.5" in page.command
        with opened(page) as browser:
            browser.change(type="set", name="f_number", value=4.0)
        assert page.scene.camera.f_number == pytest.approx(4.0) and "--f-number=4.0" in page.command


def test_a_closed_page_tells_so_and_another_one_opens(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with bokehguide.view("daylight", "uniform", 1, size=(32, 18)) as page:
        page.close()
        assert page._repr_html_() == "<p>Page(closed)</p>" and repr(page) == "Page(closed)"
        with bokehguide.view("daylight", "uniform", 1, size=(32, 18)) as other, opened(other) as browser:
            browser.rested()
    assert "--size=32x18" in page.command


def test_a_scene_of_python_can_be_viewed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with bokehguide.view(emitters(24, 16), spp=2) as page, opened(page) as browser:
        browser.rested()
        browser.send(type="save_scene")
        assert "a scene of Python" in browser.until("failure")["failure"]


@pytest.mark.parametrize("size", [np.array([32, 18]), [32, 18]], ids=["array", "list"])
def test_a_size_may_be_an_array(size, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with bokehguide.view("daylight", "uniform", 1, size=size) as page:
        assert "--size=32x18" in page.command


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"size": 32}, "view: size: 32 is no pair of whole numbers"),
        ({"f_nunber": 2.0}, "did you mean 'f_number'"),
        ({"width": 320}, "view: width: no such option; did you mean 'size'?"),
        ({"mode": "magic"}, "mode"),
        ({"fov": 500.0}, "--fov"),
    ],
)
def test_mistakes_are_named(options, words):
    with pytest.raises(bokehguide.BokehguideError, match=words):
        bokehguide.view("daylight", **options)
