"""What runs with `--device cuda`, on a device that is none: see `pretended_device.py`."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pretended_device
import pytest
import torch
from pretended_device import pretended_device as device_there

from bokehguide.scene import Overrides, load_scene
from bokehguide.train import RenderLoop, RenderSettings, settings

STEPS = 3


@pytest.fixture
def device(monkeypatch):
    monkeypatch.setattr(settings, "DEVICES", ("cpu", pretended_device.NAME))
    with device_there() as name:
        yield name


def loop_of(scene: str, mode: str, device: str) -> RenderLoop:
    loop = RenderLoop(load_scene(scene, Overrides(32, 18)), RenderSettings(mode, threads=1, device=device))
    if device != "cpu":
        loop._pool = ThreadPoolExecutor(1, initializer=pretended_device.enter)
    return loop


def picture(loop: RenderLoop) -> torch.Tensor:
    for _ in range(STEPS):
        loop.step()
    return loop.film.radiance().cpu()


MODES = [("fairy-lights", mode) for mode in ("uniform", "lis-o", "guided", "area-restir+lis")]


@pytest.mark.parametrize("scene, mode", [*MODES, ("cutout", "guided"), ("night-street", "guided")])
def test_pictures_are_those_of_a_cpu_to_the_bit(scene, mode, device):
    """And nothing mixes devices on the way, or it would fail."""
    found = picture(loop_of(scene, mode, device))
    assert found.isfinite().all() and found.max() > 0.0
    assert torch.equal(found, picture(loop_of(scene, mode, "cpu")))


def test_what_is_on_the_device_mixes_with_nothing_else(device):
    there = torch.ones(3, device=device)
    with pytest.raises(RuntimeError, match="here and there"):
        there + torch.ones(3)
    assert (there + 1.0).tolist() == [2.0, 2.0, 2.0]


WAITS = {
    "transfers.fetched": 2,  # the rays of a segment, and its shadow rays
    "pixels.parted": 2,  # how many of them met something, and how many paths go on
    "path_tracer._add_emission": 1,  # how many met lamps
    "path_tracer._add_direct_light": 1,  # how many light samples may bring something
    "lights.draw": 1,  # how many fell on the environment
}
"""How often the host may wait in a segment."""


def test_the_host_waits_for_rays_and_for_how_many_they_are_alone(device):
    loop = loop_of("fairy-lights", "uniform", device)
    loop.step()
    pretended_device.waits.clear()
    loop.step()
    waits = {place.rsplit(":", 1)[0]: 0 for place in pretended_device.waits}
    for place, count in pretended_device.waits.items():
        waits[place.rsplit(":", 1)[0]] += count
    segments = loop.tracer.max_depth
    assert all(0 < waits.pop(place) <= most * segments for place, most in WAITS.items())
    assert waits.pop("loop._trace") == 1 and waits.pop("film.add") == 1  # whether all rays pass, and all samples are finite
    assert waits == {}
