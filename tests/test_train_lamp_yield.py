"""What draws of lamps bring: learnt by tile and lamp, without a trace in the mean."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from render_checks import estimate
from statistical import SIGNIFICANCE

from bokehguide.models.lens_distribution import owners
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.shapes import spheres, transform, transformed, unit_box
from bokehguide.scene.types import Camera, Scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.train.lamp_yield import DRAWS_BEFORE, HIGHEST, TILE, LampYield

WIDTH, HEIGHT, LAMPS = 64, 37, 5
ROWS = 32
"""Of the pictures that are rendered."""
SEEN, HIDDEN = (0.1, 0.0, -6.0), (-0.1, 0.0, -6.0)


def lamp_yield(lamps: int = LAMPS) -> LampYield:
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), aperture_radius=0.1, focus_distance=2.0)
    return LampYield(ThinLensCamera(camera, WIDTH, HEIGHT), lamps)


def all_slots(learnt: LampYield, lamps: int = LAMPS) -> np.ndarray:
    """Of each pixel and lamp, `[HEIGHT, WIDTH, lamps]`."""
    pixels = WIDTH * HEIGHT
    lamp, owner = torch.arange(lamps).repeat(pixels), owners(torch.arange(pixels + 1) * lamps, pixels * lamps)
    return learnt.slots(slice(0, pixels), owner, lamp).reshape(HEIGHT, WIDTH, lamps).numpy()


def test_before_anything_is_learnt_all_draws_count_alike():
    learnt = lamp_yield()
    assert (learnt.factor(torch.from_numpy(all_slots(learnt).ravel())) == 1.0).all()


@pytest.mark.parametrize("brought", [0.0, 0.5, 1.0, 3.0, 100.0])
def test_the_factor_is_the_root_mean_square_of_what_draws_brought(brought):
    """With DRAWS_BEFORE draws that brought what they might, which count for less the more there are; of draws in vain
    ½ / (n + ½); it is bounded."""
    learnt, slots = lamp_yield(), torch.tensor([7, 8, 8, 8, 9] + [10] * 40)
    learnt.add(slots, torch.full((len(slots),), brought**2))
    assert (learnt.factor(slots) == 1.0).all()  # until the block ends
    learnt.update()
    for slot, draws in ((6, 0), (7, 1), (8, 3), (9, 1), (10, 40)):
        share = DRAWS_BEFORE / (draws + DRAWS_BEFORE)
        expected = math.sqrt((1.0 - share) * brought**2 + share**2)
        assert float(learnt.factor(torch.tensor([slot]))) == pytest.approx(min(expected, HIGHEST), rel=1e-6)


def test_what_was_found_is_not_learnt_about():
    """It has slot 0, whatever is added there; known lamps never have it."""
    learnt = lamp_yield()
    lamp, owner = torch.arange(LAMPS + 3), torch.zeros(LAMPS + 3, dtype=torch.int64)
    slots = learnt.slots(slice(100, 101), owner, lamp)
    assert (slots[:LAMPS] > 0).all() and (slots[LAMPS:] == 0).all() and all_slots(learnt).min() > 0
    learnt.add(slots, torch.zeros(len(slots)))
    learnt.update()
    factor = learnt.factor(slots)
    assert (factor[:LAMPS] < 1.0).all() and (factor[LAMPS:] == 1.0).all()


def test_a_tile_shares_its_slots_and_others_have_their_own():
    """All pixels of a tile have the same; of all tiles and lamps few have the slot of another."""
    slots = all_slots(lamp_yield())
    first = slots[::TILE, ::TILE]
    assert np.array_equal(slots, first.repeat(TILE, 0).repeat(TILE, 1)[:HEIGHT, :WIDTH])
    assert (first[1:] != first[:-1]).mean() > 0.99 and (first[:, 1:] != first[:, :-1]).mean() > 0.99
    assert (first[..., 1:] != first[..., :-1]).mean() > 0.99
    assert len(np.unique(first)) > 0.8 * first.size  # as many as of random slots
    assert first.max() < len(lamp_yield().sums[0])


def test_slots_do_not_depend_on_how_pixels_are_named():
    learnt = lamp_yield()
    owner, lamp = torch.tensor([0, 0, 1, 3, 3, 4]), torch.tensor([0, 2, 1, 4, 0, 3])
    by_slice = learnt.slots(slice(900, 905), owner, lamp)
    assert torch.equal(learnt.slots(torch.arange(900, 905), owner, lamp), by_slice)
    apart = learnt.slots(torch.tensor([17, 903, 904]), torch.tensor([1, 1, 2]), torch.tensor([4, 0, 3]))
    assert torch.equal(apart, by_slice[3:])


def half_hidden() -> Scene:
    """Two lamps that the same pixels see beside each other; a black box stands before the left one."""
    scene = scenes.lamps(WIDTH, ROWS)
    lamps = spheres(np.array([SEEN, HIDDEN]), 0.04, material=0)
    box = replace(transformed(unit_box(), transform((-0.1, 0.0, -5.6), scale=0.13)), material=1)
    camera = replace(scene.camera, fov=8.0)
    return replace(scene, camera=camera, meshes=(lamps, box), materials=(scenes.LAMP, scenes.BLACK))


def hidden_weights(loop: RenderLoop) -> torch.Tensor:
    """Mixture weights of the hidden lamp in the pixels that may see both, `[K]`."""
    pixels = loop.camera.width * loop.camera.height
    raster = torch.stack((torch.arange(pixels) % WIDTH, torch.arange(pixels) // WIDTH)) + 0.5
    mixture, spot, _ = loop.guide._mixture(slice(0, pixels), loop.camera.focus_points(raster))
    both = torch.bincount(mixture.owner[mixture.bright > 0.0], minlength=pixels) == 2
    return mixture.weight[(spot == loop.guide.field.mean[0].argmin()) & both[mixture.owner]]


def rendered(scene: Scene, steps: int) -> RenderLoop:
    loop = RenderLoop(scene, RenderSettings("guided", threads=1))
    for _ in range(steps):
        loop.step()
    return loop


def test_a_lamp_behind_something_is_hardly_drawn():
    before, after = (hidden_weights(rendered(half_hidden(), steps)) for steps in (0, 16))
    assert len(before) == len(after) > 400
    assert (after < before).float().mean() > 0.9
    assert float(before.mean()) == pytest.approx(0.5, abs=0.01) and float(after.mean()) < 0.2


def test_the_mean_is_that_of_the_uniform_lens_meanwhile():
    scene = half_hidden()
    many, few = 1024, 64
    uniform = estimate(RenderLoop(scene, RenderSettings("uniform", seed=1000, threads=1)), many)
    guided = estimate(RenderLoop(scene, RenderSettings("guided", seed=1, threads=1)), few)
    assert guided.p_value(uniform.mean, uniform.variance, (ROWS // 2,)) > SIGNIFICANCE
    assert few * guided.variance.mean() < 0.1 * many * uniform.variance.mean()


def test_what_was_learnt_is_part_of_the_state(tmp_path):
    """A fresh guide that loads it goes by the same weights, in the midst of a block as well."""
    loop, fresh = rendered(half_hidden(), 11), rendered(half_hidden(), 0)
    assert not torch.equal(hidden_weights(loop), hidden_weights(fresh))
    torch.save(loop.guide.state_dict(), tmp_path / "guide.pt")
    fresh.guide.load_state_dict(torch.load(tmp_path / "guide.pt", weights_only=True))
    assert torch.equal(hidden_weights(loop), hidden_weights(fresh))
    assert torch.equal(loop.guide.lamp_yield.sums, fresh.guide.lamp_yield.sums) and loop.guide.unit == fresh.guide.unit
