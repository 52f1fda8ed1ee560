"""Learned state of an earlier view: it changes no mean, and lowers the error of the first steps."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from bokehguide.guiding.inheritance import BEYOND, Learned, moved
from bokehguide.render.film import NO_DEPTH
from bokehguide.render.vector import luminance
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.statistical import SIGNIFICANCE, block_means, z_test

SIZE = 128, 72
RENDERS, STEPS = {"lens": 64, "camera": 64, "pinhole": 96}, 2
REFERENCE_SPP = 768
CHANGES = ("lens", "camera")
ALL_CHANGES = (*CHANGES, "pinhole")


@lru_cache
def scene_of(change: str) -> Scene:
    """fairy-lights, before a change or after it."""
    scene = load_scene("fairy-lights", Overrides(width=SIZE[0], height=SIZE[1]))
    camera = scene.camera
    if change == "lens":
        camera = replace(camera, aperture_radius=0.8 * camera.aperture_radius, focus_distance=1.2 * camera.focus_distance)
    elif change == "pinhole":
        camera = replace(camera, aperture_radius=0.0)
    elif change == "camera":
        camera = replace(camera, position=tuple(np.add(camera.position, (0.12, 0.03, 0.0))), fov=0.95 * camera.fov)
    return replace(scene, camera=camera)


def loop_of(scene: Scene, seed: int, mode: str = "guided") -> RenderLoop:
    return RenderLoop(scene, RenderSettings(mode, seed=seed, threads=1))


@lru_cache
def learned() -> Learned:
    with loop_of(scene_of(""), 1) as loop:
        for _ in range(8):
            loop.step()
        found = loop.learned()
    assert found is not None
    return found


@lru_cache
def reference(change: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean luminance and its variance by pixel, by the uniform lens."""
    with loop_of(scene_of(change), 2, "uniform") as loop:
        for _ in range(REFERENCE_SPP):
            loop.step()
        return gray(loop), loop.film.variance().double().numpy()


def gray(loop: RenderLoop) -> np.ndarray:
    return luminance(loop.film.radiance().reshape(-1, 3).T).reshape(SIZE[1], SIZE[0]).double().numpy()


@lru_cache
def pictures(change: str, keeps: bool) -> np.ndarray:
    """Pictures of few steps after the change, `[N, H, W]`."""
    found = []
    for seed in range(100, 100 + RENDERS[change]):
        with loop_of(scene_of(change), seed) as loop:
            if keeps:
                loop.inherit(learned())
            for _ in range(STEPS):
                loop.step()
            found.append(gray(loop))
    return np.stack(found)


@pytest.mark.slow
@pytest.mark.parametrize("change", ALL_CHANGES)
def test_kept_state_changes_no_mean(change):
    kept, (expected, variance) = pictures(change, True), reference(change)
    difference = block_means(kept.mean(0) - expected, 8)
    error = np.sqrt(block_means(kept.var(0, ddof=1) / len(kept) + variance, 8)) / 8
    assert z_test(difference, error) > SIGNIFICANCE
    assert z_test(1.02 * difference + 0.02 * block_means(expected, 8), error) < SIGNIFICANCE  # 2 % would be found


@pytest.mark.slow
@pytest.mark.parametrize("change", ALL_CHANGES)
def test_kept_state_lowers_the_noise(change):
    kept, fresh = (noise(pictures(change, keeps)) for keeps in (True, False))
    assert kept < 0.95 * fresh


def test_a_lens_after_a_pinhole_takes_over_the_choice_of_lights_alone():
    with loop_of(scene_of("pinhole"), 1) as pinhole:
        for _ in range(4):
            pinhole.step()
        state = pinhole.learned()
    fresh, kept = loop_of(scene_of(""), 3), loop_of(scene_of(""), 3)
    assert state is not None and not state.state["lens"]
    kept.inherit(state)
    assert float(kept.mode.lights.sampler.sums.abs().sum()) > 0.0 == float(fresh.mode.lights.sampler.sums.abs().sum())
    assert all(torch.equal(value, fresh.mode.lens.state_dict()[name]) for name, value in kept.mode.lens.state_dict().items())
    assert np.isfinite(kept.step().seconds)


def noise(found: np.ndarray) -> float:
    """Mean relative standard deviation of pixels over pictures `[N, H, W]`."""
    return float((found.std(0, ddof=1) / (found.mean(0) + 0.01)).mean())


def test_sums_move_with_their_surfaces():
    """A step to the right moves a wall at 4 m by a number of pixels to the left."""
    state = learned()
    camera = scene_of("").camera
    right = state.camera.axes[:, 0].double().numpy()
    shift = 6
    by = tuple(shift * 4.0 * state.camera.pixel_slope * right)
    aside = replace(camera, position=tuple(np.add(camera.position, by)), target=tuple(np.add(camera.target, by)))
    other = loop_of(replace(scene_of(""), camera=aside), 3).camera
    wall = replace(state, depth=torch.full_like(state.depth, 4.0))
    places = wall.pixels(other).reshape(SIZE[1], SIZE[0])
    columns = torch.arange(SIZE[0])
    torch.testing.assert_close(places[30, shift + 1 :] - 30 * SIZE[0], columns[1:-shift])
    assert (places[:, :shift] == -1).all()
    sky = replace(state, depth=torch.full_like(state.depth, NO_DEPTH))
    assert (sky.surfaces()[2] == BEYOND).all()
    assert (sky.pixels(other) == torch.arange(len(state.depth))).float().mean() > 0.99


def test_sums_that_meet_are_averaged_and_others_dropped():
    sums = torch.tensor([[1.0, 3.0, 5.0, 7.0]])
    assert moved(sums, torch.tensor([2, 2, -1, 0])).tolist() == [[7.0, 0.0, 2.0, 0.0]]


@pytest.mark.parametrize("change", CHANGES)
def test_highlights_stay_at_their_places_in_the_world(change):
    state = learned()
    loop = loop_of(scene_of(change), 3)
    loop.inherit(state)
    at = world(state.camera, state.state["lens"]["record_buffer.voxels"])
    kept = world(loop.camera, loop.mode.lens.record_buffer.voxels)
    assert len(kept) > 0.5 * len(at)
    nearest = torch.cdist(kept, at).amin(1) / kept.norm(dim=1)
    assert float(nearest.median()) < 1e-3


def world(camera, voxels: torch.Tensor) -> torch.Tensor:
    """World positions of the voxels with light, `[K, 3]`."""
    _, _, light, x, y, inverse_depth = voxels[voxels[:, 2] > 0.0].T
    points = (torch.stack((x, y, light)) / inverse_depth).float()
    return (camera.axes @ points + camera.position).T


@pytest.mark.parametrize("change", CHANGES)
def test_lights_begin_with_the_probabilities_of_the_earlier_view(change):
    """Those of the same tile in the same view, and of a nearby tile in another."""
    state, loop = learned(), loop_of(scene_of(change), 3)
    loop.inherit(state)
    with loop_of(scene_of(""), 1) as before:
        for _ in range(8):
            before.step()
        earlier = before.mode.lights.sampler.probability
    found = loop.mode.lights.sampler.probability
    assert torch.allclose(found.sum(1), torch.ones(len(found)), atol=1e-4)
    distance = (found - earlier).abs().sum(1).mean()
    even = (1.0 / earlier.shape[1] - earlier).abs().sum(1).mean()
    assert distance < (0.05 if change == "lens" else 0.7 * even)


def test_a_first_step_needs_earlier_samples():
    with loop_of(scene_of(""), 1) as loop:
        assert loop.learned() is None
    with loop_of(scene_of(""), 1, "uniform") as loop:
        loop.step()
        assert loop.learned() is None
