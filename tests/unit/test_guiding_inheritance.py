"""What a render takes over from an earlier render: choices alone, with few counts, at the places where their surfaces lie now."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from bokehguide.guiding.inheritance import Learned
from bokehguide.render import PathTracer
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.view.kept import Kept
from bokehguide.view.workers import AbandonedError, StoppableWorkers

SIZE = 64, 40
STEPS = 8
SHARE = 0.5
"""Earlier samples count for 4 of the 8 steps."""


@lru_cache
def scene() -> Scene:
    return load_scene("fairy-lights", Overrides(width=SIZE[0], height=SIZE[1]))


def with_camera(**changes) -> Scene:
    return replace(scene(), camera=replace(scene().camera, **changes))


@lru_cache
def tracer() -> PathTracer:
    return PathTracer(scene())


def loop_of(changed: Scene, seed: int = 2) -> RenderLoop:
    return RenderLoop(changed, RenderSettings("guided", seed=seed, threads=1), tracer=tracer())


def after(steps: int) -> RenderLoop:
    with loop_of(scene(), 1) as loop:
        for _ in range(steps):
            loop.step()
    return loop


@pytest.fixture(scope="module")
def earlier() -> RenderLoop:
    return after(STEPS)


@pytest.fixture(scope="module")
def learned(earlier) -> Learned:
    found = earlier.learned()
    assert found is not None
    return found


@pytest.fixture(scope="module")
def narrower(learned) -> RenderLoop:
    """A loop with a smaller aperture, that has inherited."""
    loop = loop_of(with_camera(aperture_radius=0.7 * scene().camera.aperture_radius))
    loop.inherit(learned)
    return loop


def test_an_abandoned_first_step_has_nothing_to_hand_on(learned):
    """The page keeps the state of the picture before."""
    loop = loop_of(scene())
    loop.inherit(learned)
    loop.workers = StoppableWorkers(1)
    loop.workers.stop.set()
    with loop.workers, pytest.raises(AbandonedError):
        loop.step()
    assert loop.learned() is None


def test_estimates_of_radiance_and_samples_are_not_taken_over(earlier, narrower):
    fresh = loop_of(scene())
    assert not narrower.film.radiance().any() and narrower.step_number == 0
    rest = [name for name, strategy in fresh.mode.strategies.items() if not strategy.inherits]
    assert set(fresh.mode.strategies) - set(rest) == {"lens", "lights"}
    changed = set()
    for name in rest:
        before = earlier.mode.strategies[name].state_dict()
        for key, value in fresh.mode.strategies[name].state_dict().items():
            torch.testing.assert_close(
                narrower.mode.strategies[name].state_dict()[key], value, rtol=0, atol=0, msg=f"{name}.{key}"
            )
            if before[key].shape != value.shape or not torch.equal(before[key], value):
                changed.add(name)
    assert changed  # the earlier render has learned such estimates


@pytest.mark.parametrize(("steps", "share"), [(1, 1.0), (4, 1.0), (8, 0.5), (1000, 0.004)])
def test_earlier_samples_count_for_four_steps_at_most(steps, share, learned):
    assert replace(learned, steps=steps).share == pytest.approx(share)


def test_a_lens_is_no_other_view(learned):
    camera = scene().camera
    assert learned.same_view(loop_of(with_camera(aperture_radius=0.01, focus_distance=9.0)).camera)
    aside = {"position": tuple(np.add(camera.position, 0.01)), "target": tuple(np.add(camera.target, 0.01))}
    for changes in (aside, {"target": tuple(np.add(camera.target, (0.0, 0.1, 0.0)))}, {"fov": 0.99 * camera.fov}):
        assert not learned.same_view(loop_of(with_camera(**changes)).camera), changes


def test_success_rates_stay_with_the_view(earlier, learned, narrower):
    before, now = earlier.mode.lens.success_rates, narrower.mode.lens.success_rates
    drawn = before.sums[0] > 0.0
    assert drawn.sum() > 20
    torch.testing.assert_close(now.sums, SHARE * before.sums)
    unlearned = loop_of(scene()).mode.lens.success_rates.rates
    assert (now.rates - unlearned).abs()[drawn].mean() > 0.05
    assert torch.corrcoef(torch.stack((now.rates[drawn], before.rates[drawn])))[0, 1] > 0.9
    aside = loop_of(with_camera(fov=0.9 * scene().camera.fov))
    aside.inherit(learned)
    assert not aside.mode.lens.success_rates.sums.any()


def test_highlights_keep_their_radiance(earlier, narrower):
    """Sums of light and numbers of samples have the same factor."""
    cells, points, radiance = earlier.mode.lens.record_buffer.bright(0.1)
    places, others, kept = narrower.mode.lens.record_buffer.bright(0.1)
    assert len(cells) > 10 and torch.equal(cells, places)
    torch.testing.assert_close(others, points, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(kept, radiance, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(narrower.mode.lens.record_buffer.sums[0], SHARE * earlier.mode.lens.record_buffer.sums[0])


def test_after_a_move_all_cells_have_the_mean_number_of_samples(earlier, learned):
    loop = loop_of(with_camera(fov=0.9 * scene().camera.fov))
    loop.inherit(learned)
    count = earlier.mode.lens.record_buffer.sums[0]
    expected = SHARE * count[count > 0.0].mean()
    torch.testing.assert_close(loop.mode.lens.record_buffer.sums[0], expected.expand(len(count)))


def test_moments_go_on_in_the_unit_of_the_earlier_frame(earlier, learned, narrower):
    """The first step of a render divides its moments by the squared mean luminance of the frame, then unknown."""
    before = earlier.mode.lens.moments
    assert before.any()
    frame = learned.mean_luminance
    assert frame == pytest.approx(float(earlier.film.radiance().mean()), rel=0.5) and abs(frame - 1.0) > 0.1
    torch.testing.assert_close(narrower.mode.lens.moments / frame**2, SHARE * before)
    assert len(narrower.mode.lens.beta.unique()) > 100


def test_moments_move_with_the_surfaces(learned):
    """A frame that shows a wall from a place further right has the moments further left."""
    shift = 5
    aside, wall = moved_right(learned, shift, 0)
    loop = loop_of(aside)
    moments = torch.rand(2, SIZE[1], SIZE[0], generator=torch.Generator().manual_seed(1)).to(learned.state["lens"]["moments"])
    state = {**wall.state, "lens": {**wall.state["lens"], "moments": moments.reshape(wall.state["lens"]["moments"].shape)}}
    loop.inherit(replace(wall, state=state))
    found = loop.mode.lens.moments.reshape(moments.shape) / learned.mean_luminance**2
    torch.testing.assert_close(found[:, 1:-1, 1 : -shift - 1], SHARE * moments[:, 1:-1, shift + 1 : -1])
    assert not found[:, :, -shift + 1 :].any()


def test_sums_of_lights_move_to_the_tiles_of_their_surfaces(learned):
    """The wall moves left and up by two tiles and one; tiles without samples have the mean of all with the weight of one."""
    sampler = loop_of(scene()).mode.lights.sampler
    size, across, down = sampler._size, *sampler.pools
    aside, wall = moved_right(learned, 2 * size, size)
    sums = torch.rand(3, down, across, sampler.sums.shape[2], generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    loop = loop_of(aside)
    state = {**wall.state, "lights": {**wall.state["lights"], "sampler.sums": sums.flatten(1, 2)}}
    loop.inherit(replace(wall, state=state))
    found = loop.mode.lights.sampler.sums.unflatten(1, (down, across))
    torch.testing.assert_close(found[:, : down - 1, : across - 2], SHARE * sums[:, 1:, 2:])
    mean = sums[:, 1:, 2:].flatten(1, 2).sum(1) / (down * across)
    torch.testing.assert_close(found[:, down - 1 :].flatten(1, 2), (mean / mean[1].sum())[:, None].expand(3, across, -1))


def moved_right(learned: Learned, right: int, down: int) -> tuple[Scene, Learned]:
    """The scene from a place further right and down, by numbers of pixels of a wall at 4 m; learned state before such a wall."""
    camera = scene().camera
    axes = learned.camera.axes.double().numpy()
    by = 4.0 * learned.camera.pixel_slope * (right * axes[:, 0] - down * axes[:, 1])
    aside = with_camera(position=tuple(camera.position + by), target=tuple(camera.target + by))
    return aside, replace(learned, depth=torch.full_like(learned.depth, 4.0))


def test_what_is_handed_on_has_the_samples_since_the_last_epoch():
    counts = []
    for steps in (2, 3):
        found = after(steps).learned()
        assert found is not None
        rows = [found.state["lens"][f"record_buffer.{name}"] for name in ("voxels", "waiting")]
        counts.append(float(torch.cat(rows)[:, 1].sum()))
    assert counts[1] > 1.3 * counts[0]


def test_a_picture_without_a_step_forgets_nothing(earlier):
    """As when the camera moves on before the first step at the full size."""
    kept = Kept()
    kept.take(earlier)
    first = kept.learned("guided", tracer())
    assert first is not None and first.steps == STEPS
    kept.take(loop_of(scene()))
    assert kept.learned("guided", tracer()) is first
    assert kept.learned("lis-o", tracer()) is None and kept.learned("guided", PathTracer(scene())) is None
    assert kept.learned("guided", tracer()) is first
