"""Success rates of draws of emitters: learned by tile and emitter, without bias."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.guiding.success_rates import MAX_RATE, PRIOR_DRAWS, TILE, SuccessRates
from bokehguide.models.base import owners
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.shapes import spheres, transform, transformed, unit_box
from bokehguide.scene.types import Camera, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.guides import mixture_query, pixel_batch
from tests.support.render_checks import estimate
from tests.support.statistical import SIGNIFICANCE

WIDTH, HEIGHT, EMITTERS = 66, 37, 5
"""No whole number of tiles."""
COLUMNS, ROWS = 64, 32
"""Size of the rendered pictures, pixels."""
SEEN, HIDDEN = (0.1, 0.0, -6.0), (-0.1, 0.0, -6.0)


def success_rates(emitters: int = EMITTERS) -> SuccessRates:
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), aperture_radius=0.1, focus_distance=2.0)
    return SuccessRates(ThinLensCamera(camera, WIDTH, HEIGHT), emitters)


def all_slots(rates: SuccessRates, emitters: int = EMITTERS) -> np.ndarray:
    """Slots of each pixel and emitter, `[HEIGHT, WIDTH, emitters]`."""
    pixels = WIDTH * HEIGHT
    emitter, owner = torch.arange(emitters).repeat(pixels), owners(torch.arange(pixels + 1) * emitters, pixels * emitters)
    return rates.slots(slice(0, pixels), owner, emitter).reshape(HEIGHT, WIDTH, emitters).numpy()


def test_all_rates_are_one_at_the_start():
    rates = success_rates()
    assert (rates.rates == 1.0).all()


@pytest.mark.parametrize("contribution", [0.0, 0.5, 1.0, 3.0, 100.0])
def test_the_rate_is_the_root_mean_square_of_contributions(contribution):
    """The prior is PRIOR_DRAWS draws with contribution 1, which weigh less with more draws. The rate is bounded."""
    rates, slots = success_rates(), torch.tensor([7, 8, 8, 8, 9] + [10] * 40)
    rates.add([(slots, torch.full((len(slots),), contribution**2))])
    assert (rates.rates[slots] == 1.0).all()  # until the epoch ends
    rates.update()
    for slot, draws in ((6, 0), (7, 1), (8, 3), (9, 1), (10, 40)):
        share = PRIOR_DRAWS / (draws + PRIOR_DRAWS)
        expected = math.sqrt((1.0 - share) * contribution**2 + share**2)
        assert float(rates.rates[slot]) == pytest.approx(min(expected, MAX_RATE), rel=1e-6)


def test_found_highlights_have_no_rate():
    """They have slot 0, whose rate stays 1; known emitters never have slot 0."""
    rates = success_rates()
    emitter, owner = torch.arange(EMITTERS + 3), torch.zeros(EMITTERS + 3, dtype=torch.int64)
    slots = rates.slots(slice(100, 101), owner, emitter)
    assert (slots[:EMITTERS] > 0).all() and (slots[EMITTERS:] == 0).all() and all_slots(rates).min() > 0
    rates.add([(slots, torch.zeros(len(slots)))])
    rates.update()
    learned = rates.rates[slots]
    assert (learned[:EMITTERS] < 1.0).all() and (learned[EMITTERS:] == 1.0).all()


def test_each_tile_has_slots_of_its_own():
    """All pixels of a tile have the same slots; few tiles and emitters share a slot."""
    slots = all_slots(success_rates())
    first = slots[::TILE, ::TILE]
    assert np.array_equal(slots, first.repeat(TILE, 0).repeat(TILE, 1)[:HEIGHT, :WIDTH])
    assert (first[1:] != first[:-1]).mean() > 0.99 and (first[:, 1:] != first[:, :-1]).mean() > 0.99
    assert (first[..., 1:] != first[..., :-1]).mean() > 0.99 and (first[1:, 0] != first[:-1, -1]).mean() > 0.9
    assert len(np.unique(first)) > 0.8 * first.size  # as many as of random slots
    assert first.max() < len(success_rates().sums[0])


def test_slots_are_the_same_for_a_slice_and_for_indices():
    rates = success_rates()
    owner, emitter = torch.tensor([0, 0, 1, 3, 3, 4]), torch.tensor([0, 2, 1, 4, 0, 3])
    by_slice = rates.slots(slice(900, 905), owner, emitter)
    assert torch.equal(rates.slots(torch.arange(900, 905), owner, emitter), by_slice)
    apart = rates.slots(torch.tensor([17, 903, 904]), torch.tensor([1, 1, 2]), torch.tensor([4, 0, 3]))
    assert torch.equal(apart, by_slice[3:])


def half_hidden() -> Scene:
    """Two emitters that the same pixels see beside each other; a black box stands before the left one."""
    scene = scenes.emitters(COLUMNS, ROWS)
    emitters = spheres(np.array([SEEN, HIDDEN]), 0.04, material=0)
    box = replace(transformed(unit_box(), transform((-0.1, 0.0, -5.6), scale=0.13)), material=1)
    camera = replace(scene.camera, fov=8.0)
    return replace(scene, camera=camera, meshes=(emitters, box), materials=(scenes.LAMP, scenes.BLACK))


def hidden_weights(loop: RenderLoop) -> torch.Tensor:
    """Mixture weights of the hidden emitter in the pixels that may see both, `[K]`."""
    guide = loop.mode.lens
    query = mixture_query(guide, pixel_batch(guide))
    mixture = query.mixture
    both = torch.bincount(mixture.owner[mixture.expected_contribution > 0.0], minlength=COLUMNS * ROWS) == 2
    return mixture.weight[(query.component == guide.field.mean[0].argmin()) & both[mixture.owner]]


def rendered(scene: Scene, steps: int) -> RenderLoop:
    with RenderLoop(scene, RenderSettings("guided", threads=1)) as loop:
        for _ in range(steps):
            loop.step()
    return loop


def test_a_hidden_emitter_is_hardly_drawn():
    before, after = (hidden_weights(rendered(half_hidden(), steps)) for steps in (0, 16))
    assert len(before) == len(after) > 400
    assert (after < before).float().mean() > 0.9
    assert float(before.mean()) == pytest.approx(0.5, abs=0.01) and float(after.mean()) < 0.2


def test_the_rate_of_a_visible_emitter_is_near_one():
    guide = rendered(half_hidden(), 16).mode.lens
    query = mixture_query(guide, pixel_batch(guide))
    visible = query.component == guide.field.mean[0].argmax()
    rates = guide.success_rates.rates[query.slots[visible]]
    assert len(rates) > 400 and float(rates.median()) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_the_mean_is_that_of_the_uniform_lens():
    scene = half_hidden()
    many, few = 1024, 64
    uniform = estimate(RenderLoop(scene, RenderSettings("uniform", seed=1000, threads=1)), many)
    guided = estimate(RenderLoop(scene, RenderSettings("guided", seed=1, threads=1)), few)
    assert guided.p_value(uniform.mean, uniform.variance, (ROWS // 2,)) > SIGNIFICANCE
    assert few * guided.variance.mean() < 0.1 * many * uniform.variance.mean()


def test_rates_are_part_of_the_state(tmp_path):
    """A new guide that loads the state has the same weights, also within an epoch."""
    loop, other = rendered(half_hidden(), 11), rendered(half_hidden(), 0)
    guide, loaded = loop.mode.lens, other.mode.lens
    assert not torch.equal(hidden_weights(loop), hidden_weights(other))
    torch.save(guide.state_dict(), tmp_path / "guide.pt")
    loaded.load_state_dict(torch.load(tmp_path / "guide.pt", weights_only=True))
    assert torch.equal(hidden_weights(loop), hidden_weights(other))
    assert torch.equal(guide.success_rates.sums, loaded.success_rates.sums) and guide.unit == loaded.unit
