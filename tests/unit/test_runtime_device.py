"""The code for `--device cuda`, on the simulated device of `pretended_device.py`."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from bokehguide.render.film import Film, FilmSamples
from bokehguide.runtime.indexing import ActiveEntries, PendingIndices, indices, indices_of_each
from bokehguide.runtime.native import SWITCH
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Material, Scene, Texture
from bokehguide.train import RenderLoop, RenderSettings, settings
from tests.support import pretended_device, scenes
from tests.support.pretended_device import pretended_device as device_there
from tests.support.tracing import rectangle

STEPS = 3


@pytest.fixture
def device(monkeypatch):
    monkeypatch.setattr(settings, "DEVICES", ("cpu", pretended_device.NAME))
    with device_there() as name:
        yield name


def painted() -> Scene:
    """Emitters before a wall with colour, emission and normal maps, glass with a transmission map, and plain wood."""
    generator = np.random.default_rng(4)
    images = [np.clip(generator.random((8, 8, 4), np.float32), *ends) for ends in ((0.0, 1.0), (0.4, 0.6))]
    colors, normals = (Texture(image) for image in images)
    wall = Material("wall", base_color_texture=colors, normal_texture=normals, emission=(0.2,) * 3, emission_texture=colors)
    glass = Material("glass", roughness=0.2, transmission=0.9, transmission_texture=colors, double_sided=True)
    scene = scenes.emitters(32, 18)
    side = rectangle(2, (1.0, 0.0, -5.0), (0.0, -60.0, 0.0))
    meshes = (*scene.meshes, rectangle(1, (0.0, 0.0, -8.0), scale=3.0), side, rectangle(3, (-0.4, 0.0, -3.0), scale=0.3))
    materials = (*scene.materials, wall, Material("wood"), glass)
    return replace(scene, meshes=meshes, materials=materials, film=replace(scene.film, max_depth=5))


def loop_of(scene: str, mode: str, device: str) -> RenderLoop:
    own = {"painted": painted, "emitters": partial(scenes.emitters, 64, 36)}
    loaded = own[scene]() if scene in own else load_scene(scene, Overrides(32, 18))
    loop = RenderLoop(loaded, RenderSettings(mode, threads=1, device=device))
    if device != "cpu":
        loop.workers.submit(pretended_device.enter).result()  # on its only thread
    return loop


def picture(loop: RenderLoop) -> torch.Tensor:
    for _ in range(STEPS):
        loop.step()
    return loop.film.radiance().cpu()


MODES = [("fairy-lights", mode) for mode in ("uniform", "lis-o", "guided", "area-restir+lis")]


@pytest.mark.slow
@pytest.mark.parametrize("scene, mode", [*MODES, ("cutout", "guided"), ("night-street", "guided"), ("painted", "guided")])
def test_pictures_are_those_of_a_cpu_to_the_bit(scene, mode, device, monkeypatch):
    """Operations that mix devices raise an error. Both renders use PyTorch: the native core rounds otherwise."""
    monkeypatch.setenv(SWITCH, "0")
    found = picture(loop_of(scene, mode, device))
    assert found.isfinite().all() and found.max() > 0.0
    assert torch.equal(found, picture(loop_of(scene, mode, "cpu")))


def test_operations_that_mix_devices_fail(device):
    there = torch.ones(3, device=device)
    with pytest.raises(RuntimeError, match="here and there"):
        there + torch.ones(3)
    assert (there + 1.0).tolist() == [2.0, 2.0, 2.0]


@pytest.mark.parametrize("size", [0, 1, 10_000])
def test_indices_are_those_of_a_cpu(size, device):
    generator = torch.Generator().manual_seed(size)
    masks = [torch.rand(size // part, generator=generator) < share for part, share in ((1, 0.3), (2, 0.0), (3, 1.0))]
    pretended_device.waits.clear()
    found = indices_of_each([mask.to(device) for mask in masks])
    assert pretended_device.waits.total() <= len(masks) + 1  # the masks' way there, and one for all sizes
    assert all(torch.equal(places.cpu(), indices(mask)) for places, mask in zip(found, masks))


def test_active_entries_need_no_wait_on_a_device(device):
    """Entries are the active ones on a CPU, and all on a device; results are the same."""
    mask = torch.tensor([False, True, False, True])
    for place, entries in (("cpu", [1, 3]), (device, [0, 1, 2, 3])):
        there, values, sums = mask.to(place), torch.arange(8.0).reshape(2, 4).to(place), torch.zeros(4).to(place)
        pretended_device.waits.clear()
        active = ActiveEntries(there)
        selected = active.select(values)
        sums.index_add_(0, active.index, active.masked(10.0 * selected[0], 0.0))
        active.scatter(values, -selected)
        active.scatter(values[0], 7.0)
        assert not pretended_device.waits and len(active) == len(entries)
        assert active.index.tolist() == entries and sums.tolist() == [0.0, 10.0, 0.0, 30.0]
        assert values.tolist() == [[0.0, 7.0, 2.0, 7.0], [4.0, -5.0, 6.0, -7.0]]


def test_pending_indices_are_not_waited_for_twice(device):
    masks = [torch.rand(1000) < share for share in (0.2, 0.8)]
    there = [mask.to(device) for mask in masks]
    for does_other_things in (True, False):
        places = PendingIndices(there)
        if does_other_things:
            there[0].sum().item()
        pretended_device.waits.clear()
        found = places.get()
        assert pretended_device.waits.total() == (not does_other_things)
        assert all(torch.equal(one.cpu(), indices(mask)) for one, mask in zip(found, masks))


def test_bad_samples_are_found_later(device):
    """On a device, at the end of a step or on demand. The film never contains them."""
    here, there = Film(4, 3, seed=5), Film(4, 3, seed=5, device=device)
    for film in (here, there):
        for pixels in (slice(0, 6), slice(6, 12)):
            numbers = torch.arange(pixels.start, pixels.stop)
            value = torch.where((numbers == 3) | (numbers == 10), torch.nan, 1.0).expand(3, -1)
            place, zero = str(film.radiance().device), torch.zeros(3, 6)
            parts = (torch.ones(6), value, torch.ones(6), torch.ones(6), zero, zero, zero)
            film.add(pixels, FilmSamples(*(part.to(place) for part in parts)), step=2)
    assert torch.equal(here.radiance(), there.radiance().cpu())
    assert there.bad_count == here.bad_count == 2 and there.bad_samples == here.bad_samples
    assert [(bad.x, bad.y, bad.step, bad.seed) for bad in there.bad_samples] == [(3, 0, 2, 5), (2, 2, 2, 5)]


def test_the_record_merges_samples_of_host_and_device(device):
    """Samples that a rank has summed are on the host."""
    record = loop_of("fairy-lights", "guided", device).mode.lens.record_buffer
    rows = torch.ones(3, 6, dtype=torch.float64)
    record._new = [rows, rows.to(device)]
    record.merge()
    assert record.waiting.tolist() == [[1.0] + [6.0] * 5]


OF_UNIFORM = {"indexing.get": 1}  # the bad samples of all batches
OF_GUIDED = {
    "indexing.get": 2,  # the bad samples, and those for the record
    "film.light": 1,
    "step_stats.step_stats": 1,
}
"""Waits of the host in a step of one batch, besides those for rays; pixels reuse each other's paths once."""


OF_LEARNING = {"indexing.get": 1, "film.light": 1, "step_stats.step_stats": 1}
"""Waits in a step in which the paper's guide learns with a fixed set of Gaussians."""
WAITS = [
    pytest.param(scene, *each, marks=pytest.mark.slow)
    for scene in ("fairy-lights", "night-street", "painted")
    for each in (("uniform", OF_UNIFORM), ("guided", OF_GUIDED))
]


@pytest.mark.parametrize("scene, mode, others", [*WAITS, ("emitters", "lis-o", OF_LEARNING)])
def test_the_host_waits_for_rays_and_little_else(scene, mode, others, device):
    loop = loop_of(scene, mode, device)
    for _ in range(9 if mode == "lis-o" else 5):  # the next one is within a block
        loop.step()
    assert mode != "lis-o" or loop.mode.lens.offsets is not None
    pretended_device.waits.clear()
    loop.step()
    waits = Counter()
    for place, count in pretended_device.waits.items():
        waits[place.rsplit(":", 1)[0]] += count
    segments = loop.tracer.max_depth
    assert 0 < waits.pop("device.to_host") <= max(2 * segments - (mode != "guided"), 1)  # the last segment samples no lights
    assert all(0 < waits.pop(place, 0) <= most for place, most in others.items())
    assert not waits
