"""Pictures of a view that another program moves: each is the one of `bokehguide.render`, and changes start it anew."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
import pytest

import bokehguide
from bokehguide.scene import FilmSettings, Scene, load_scene
from bokehguide.view.job import reduced_window
from bokehguide.view.live import Live, LivePicture, LiveView
from bokehguide.view.preview import QuickDenoiser
from tests.support.scene_text import BOX_AND_EMITTER

SPP = 3
SIZE = (400, 240)
WINDOW = (250, 10, 100, 210)


class Pictures:
    """What a `Live` has published."""

    def __init__(self) -> None:
        self.told: queue.Queue[LivePicture | str] = queue.Queue()
        self.live = Live(self.told.put, lambda view, reason: self.told.put(reason), threads=2)
        self._thread = threading.Thread(target=self.live.run)

    def next(self) -> LivePicture | str:
        return self.told.get(timeout=60.0)

    def last(self, view: LiveView) -> LivePicture:
        """The picture of a view that has all samples."""
        while True:
            picture = self.next()
            assert isinstance(picture, LivePicture), picture
            if picture.view == view and picture.step == view.spp:
                return picture

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.live.close()
        self._thread.join(30.0)
        assert not self._thread.is_alive()


@pytest.fixture
def pictures() -> Iterator[Pictures]:
    with Pictures() as running:
        yield running


@pytest.fixture
def view(tmp_path: Path) -> LiveView:
    path = tmp_path / "box.toml"
    path.write_text(BOX_AND_EMITTER)
    camera = replace(load_scene(path).camera, up=(0.1, 1.0, 0.0), aperture_radius=0.08)
    return LiveView(str(path), camera, SIZE, (0, 0, *SIZE), SPP)


def scene_of(view: LiveView) -> Scene:
    scene = load_scene(view.scene)
    return replace(scene, camera=view.camera, film=replace(scene.film, width=SIZE[0], height=SIZE[1]))


@pytest.mark.parametrize("window", [None, WINDOW])
def test_the_picture_at_rest_is_that_of_a_render(window, pictures, view):
    if window is not None:
        view = replace(view, window=window)
    pictures.live.show(view)
    first = pictures.next()
    assert isinstance(first, LivePicture) and first.step == 0
    assert first.pixels.shape[0] < view.window[3] and first.pixels.shape[1] < view.window[2]
    shape = first.pixels.shape[1] / first.pixels.shape[0]
    assert shape == pytest.approx(view.window[2] / view.window[3], rel=0.1)
    render = bokehguide.render(scene_of(view), spp=SPP, crop=window, quiet=True)
    pixels = pictures.last(view).pixels
    np.testing.assert_array_equal(pixels[..., :3], render.beauty)
    np.testing.assert_array_equal(pixels[..., 3], render.alpha)


def test_another_view_starts_anew(pictures, view):
    """The first view would take minutes."""
    pictures.live.show(replace(view, spp=100_000))
    while pictures.next().step < 2:
        pass
    other = replace(view, camera=replace(view.camera, fov=70.0))
    pictures.live.show(other)
    rested = pictures.last(other)
    pictures.live.show(view)
    assert np.abs(pictures.last(view).pixels - rested.pixels).mean() > 0.01


def test_another_scene_is_read(pictures, view, tmp_path):
    pictures.live.show(view)
    before = pictures.last(view).pixels
    path = tmp_path / "other.toml"
    path.write_text(BOX_AND_EMITTER.replace("[0.02, 0.03, 0.05]", "[3.0, 3.0, 3.0]"))
    other = replace(view, scene=str(path))
    pictures.live.show(other)
    assert pictures.last(other).pixels[..., :3].mean() > before[..., :3].mean() + 1.0


def test_a_broken_scene_is_told(pictures, view, tmp_path):
    pictures.live.show(replace(view, scene=str(tmp_path / "missing.toml")))
    reason = pictures.next()
    assert isinstance(reason, str) and "missing.toml" in reason
    pictures.live.show(view)
    assert pictures.last(view).step == SPP


def test_denoising(pictures, view):
    pytest.importorskip("mitsuba_oidn")
    pictures.live.show(view)
    noisy = pictures.last(view).pixels
    denoised = replace(view, denoise=True)
    pictures.live.show(denoised)
    shown = pictures.last(denoised).pixels[..., :3]
    render = bokehguide.render(scene_of(view), spp=SPP, denoise=True, quiet=True)
    expected = QuickDenoiser()(render.beauty)
    assert np.abs(expected - render.beauty).mean() > 1e-3 and np.abs(render.beauty - noisy[..., :3]).max() > 1e-3
    np.testing.assert_allclose(shown, expected, rtol=1e-4, atol=1e-5)


def test_windows_stay_inside_of_reduced_frames():
    for width, height in ((1, 1), (2, 1), (25, 15), (100, 60)):
        film = FilmSettings(width, height)
        for window in (WINDOW, (399, 239, 1, 1), (0, 0, *SIZE), (120, 0, 280, 7)):
            left, top, across, down = reduced_window(window, SIZE[0], film)
            assert 0 <= left < left + across <= width and 0 <= top < top + down <= height
    assert reduced_window((50, 20, 100, 80), SIZE[0], FilmSettings(200, 120)) == (25, 10, 50, 40)
