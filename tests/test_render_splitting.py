"""Paths that split at their first surface: the same mean with less noise, and nothing counted twice."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.scene.types import Material, Scene
from tests.statistical import SIGNIFICANCE
from tests.test_render_light_choice import RAY, learnt_choice
from tests.test_render_pencils import as_in_a_render
from tests.test_render_mis import MATERIALS, room, sky_with_a_window
from tests.test_render_random import independence, uniformity
from tests.tracing import DOWN, UP, agreement, lamp, matte, rectangle, scene, sky

COUNT = 40_000
SHOWROOM = room(MATERIALS["glossy metal"], sky_with_a_window(6.0), lamp(2.0))


def traced(lit: Scene, parts, ray=RAY, choice_of=None, count: int = COUNT, seed: int = 0) -> PathSamples:
    """Paths along `count` copies of a ray; parts: into how many each splits, one number or `[count]`, or None."""
    tracer = PathTracer(lit)
    origin = torch.tensor(ray[0])[:, None].repeat(1, count)
    direction = torch.nn.functional.normalize(torch.tensor(ray[1])[:, None].repeat(1, count), dim=0)
    choose = None if choice_of is None else lambda points: choice_of(tracer.lights, points.shape[1])
    parts = None if parts is None else torch.as_tensor(parts).expand(count)
    random = PixelRandom(seed, 1, torch.arange(count))
    return tracer.trace(origin, direction, random, PhaseTimer(), choose=choose, parts=parts)


def light(samples: PathSamples) -> np.ndarray:
    return samples.radiance.double().numpy()


def several() -> torch.Tensor:
    """From 1 to 5 parts, in no order."""
    return torch.randint(1, 6, (COUNT,), generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("choice_of", [None, learnt_choice], ids=["plain", "learnt lights"])
def test_the_mean_stays_and_the_variance_falls(choice_of):
    whole = light(traced(SHOWROOM, None, choice_of=choice_of, count=2 * COUNT))
    parts = several()
    split = light(traced(SHOWROOM, parts, choice_of=choice_of, seed=1))
    assert agreement(split, whole) > SIGNIFICANCE
    for number in range(1, 6):  # all that is random lies beyond the first surface
        np.testing.assert_allclose(split[:, parts == number].var(1) * number, whole.var(1), rtol=0.25)


@pytest.mark.parametrize("mistake", ["shares", "numbers"])
def test_mistakes_show(mistake, monkeypatch):
    """Paths that take no share of the throughput, and such as take the same random numbers."""
    whole = light(traced(SHOWROOM, None))
    if mistake == "shares":
        assert agreement(3.0 * light(traced(SHOWROOM, 3, seed=1)), whole) < 1e-9
        return
    monkeypatch.setattr(PixelRandom, "copies", lambda self, number: self)
    same = light(traced(SHOWROOM, 3))
    np.testing.assert_allclose(same.var(1), whole.var(1), rtol=1e-3)


def test_one_part_is_no_split():
    """But for the order in which light is added up."""
    one, whole = traced(SHOWROOM, 1, choice_of=learnt_choice), traced(SHOWROOM, None, choice_of=learnt_choice)
    torch.testing.assert_close(one.radiance, whole.radiance, rtol=1e-6, atol=0.0)
    assert torch.equal(one.emission, whole.emission) and one.rays == whole.rays
    assert all(torch.equal(a, b) for a, b in zip(one.lights, whole.lights))


def test_the_first_of_the_parts_goes_on_as_the_whole_would():
    """From whose light samples may be told what went on: they come path by path."""
    parts = several()
    split, whole = traced(SHOWROOM, parts, choice_of=learnt_choice), traced(SHOWROOM, None, choice_of=learnt_choice)
    first = parts.cumsum(0) - parts
    assert len(split.lights.cluster) == int(parts.sum())
    assert torch.equal(split.lights.cluster[first], whole.lights.cluster)
    assert torch.equal(split.lights.worth[first], whole.lights.worth)


def test_what_the_first_surface_emits_counts_once():
    glowing = matte(0.5, emission=(1.0, 2.0, 3.0))
    alone = scene([rectangle(0)], [glowing], max_depth=4)
    samples = traced(alone, 7, ((0.0, 0.0, 1.0), (0.1, 0.0, -1.0)), count=100)
    assert torch.equal(samples.radiance, torch.tensor([1.0, 2.0, 3.0])[:, None].expand(3, 100))
    assert torch.equal(samples.emission, samples.radiance)


def test_rays_that_miss_and_rays_that_are_not_traced_do_not_split():
    lit = scene([rectangle(0)], [matte(0.5)], sky(1.0), max_depth=3)
    tracer, count = PathTracer(lit), 1000
    origin = torch.tensor([0.0, 0.0, 1.0])[:, None].repeat(1, count)
    direction = torch.nn.functional.normalize(torch.randn(3, count, generator=torch.Generator().manual_seed(2)), dim=0)
    parts, index = torch.arange(count) % 4 + 1, torch.arange(0, count, 3)
    random = PixelRandom(0, 1, torch.arange(count))
    alive = torch.zeros(count).index_fill(0, index, 0.5)
    found = tracer.trace(origin, direction, random, PhaseTimer(), alive=alive, parts=parts).radiance
    expected = tracer.trace(origin, direction, random, PhaseTimer(), parts=parts).radiance
    assert torch.equal(found[:, index], expected[:, index])
    assert not found.index_fill(1, index, 0.0).any()
    missed = direction[2] >= 0.0
    assert (expected[:, missed] == 1.0).all() and int(missed.sum()) > 400


def test_a_mirror_shows_the_same_image_to_all_parts():
    """A lamp before a flat mirror, seen as far behind it."""
    polished = Material("polished", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
    mirrored = scene([rectangle(0, rotate=UP), rectangle(1, (0.0, 2.0, 0.0), DOWN)], [polished, lamp(double_sided=True)])
    ray = ((0.3, 1.0, 0.0), (0.0, -1.0, 0.0))
    samples = traced(mirrored, 5, ray, lambda lights, count: as_in_a_render(torch.zeros(3, count)), 100)
    torch.testing.assert_close(samples.distance, torch.full((100,), 1.0), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(samples.image, torch.full((100,), 3.0), rtol=1e-2, atol=0.0)


def test_the_numbers_of_copies_are_uniform_and_independent():
    random, pixels = PixelRandom(0, 1, torch.arange(1 << 18)), 1 << 18
    numbers = [random.copies(torch.full((pixels,), copy)).uniform(32, 1)[0].numpy() for copy in range(4)]
    assert np.array_equal(numbers[0], random.uniform(32, 1)[0].numpy())
    for copy in range(1, 4):
        assert uniformity(numbers[copy]) > SIGNIFICANCE
        assert independence(numbers[copy - 1], numbers[copy]) > SIGNIFICANCE
    assert independence(numbers[1][:-1], numbers[2][1:]) > SIGNIFICANCE
