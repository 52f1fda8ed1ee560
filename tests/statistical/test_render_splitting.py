"""Paths that split at their primary hit: the same mean with less noise, and no light counted twice."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bokehguide.guiding.light_sampler import LightSampleRecorder
from bokehguide.guiding.virtual_images import ImageDistances, ImageRecorder
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.splitting import UNSPLIT, SplitPaths
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Material, Scene
from tests.support.choice_cases import ROOM_RAY, Everywhere, learned_choice
from tests.support.rooms import MATERIALS, room, sky_with_a_window
from tests.support.statistical import SIGNIFICANCE, independence, uniformity
from tests.support.tracing import DOWN, UP, agreement, emitter, matte, rectangle, scene, sky

COUNT = 40_000
SHOWROOM = room(MATERIALS["glossy metal"], sky_with_a_window(6.0), emitter(2.0))


class Traced:
    """The samples of a trace, light samples if a table chose them, and image distances."""

    def __init__(self, samples: PathSamples, lights: LightSampleRecorder, images: ImageRecorder):
        self.samples, self.lights = samples, lights.samples[0] if lights.samples else None
        self.image = ImageDistances(images, samples.radiance, samples.distance, 0.0).distances()


def traced(lit: Scene, parts, ray=ROOM_RAY, choice_of=None, count: int = COUNT, seed: int = 0) -> Traced:
    """Paths along `count` copies of a ray; parts: the split count, one number or `[count]`, None for no splitting."""
    tracer = PathTracer(lit)
    origin = torch.tensor(ray[0])[:, None].repeat(1, count)
    direction = torch.nn.functional.normalize(torch.tensor(ray[1])[:, None].repeat(1, count), dim=0)
    sampler = None if choice_of is None else Everywhere(lambda points: choice_of(tracer.light_sampler, points.shape[1]))
    splitting = UNSPLIT if parts is None else SplitPaths(torch.as_tensor(parts).expand(count))
    random, lights = PixelRandom(seed, 1, torch.arange(count)), LightSampleRecorder()
    images = ImageRecorder(tracer.geometry, count)
    traced = {"light_sampler": sampler, "splitting": splitting, "observers": (lights, images)}
    return Traced(tracer.trace(origin, direction, random, PhaseTimer(), **traced), lights, images)


def light(traced: Traced) -> np.ndarray:
    return traced.samples.radiance.double().numpy()


def several() -> torch.Tensor:
    """Split counts from 1 to 5, in random order."""
    return torch.randint(1, 6, (COUNT,), generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("choice_of", [None, learned_choice], ids=["plain", "learned lights"])
def test_the_mean_stays_and_the_variance_falls(choice_of):
    whole = light(traced(SHOWROOM, None, choice_of=choice_of, count=2 * COUNT))
    parts = several()
    split = light(traced(SHOWROOM, parts, choice_of=choice_of, seed=1))
    assert agreement(split, whole) > SIGNIFICANCE
    ratios = {number: split[:, parts == number].var(1) * number / whole.var(1) for number in range(1, 6)}
    np.testing.assert_allclose(ratios[1], 1.0, rtol=0.25)
    for number in range(2, 6):  # all random numbers are used after the primary hit, and a pair is stratified
        assert ratios[number].max() < 0.8


@pytest.mark.parametrize("mistake", ["shares", "numbers"])
def test_deliberate_mistakes_fail(mistake, monkeypatch):
    """Paths without a share of the throughput, and paths with the same random numbers."""
    whole = light(traced(SHOWROOM, None))
    if mistake == "shares":
        assert agreement(3.0 * light(traced(SHOWROOM, 3, seed=1)), whole) < 1e-9
        return
    monkeypatch.setattr(PixelRandom, "copies", lambda self, number: self)
    same = light(traced(SHOWROOM, 3))
    np.testing.assert_allclose(same.var(1), whole.var(1), rtol=1e-3)


def test_a_split_count_of_one_changes_nothing():
    """Except for the order of sums."""
    one, whole = traced(SHOWROOM, 1, choice_of=learned_choice), traced(SHOWROOM, None, choice_of=learned_choice)
    torch.testing.assert_close(one.samples.radiance, whole.samples.radiance, rtol=1e-6, atol=0.0)
    assert torch.equal(one.samples.emission, whole.samples.emission) and one.samples.rays == whole.samples.rays
    assert all(torch.equal(a, b) for a, b in zip(one.lights, whole.lights))


def test_the_first_part_continues_as_an_unsplit_path():
    """Light samples show it: they are in the order of paths."""
    parts = several()
    split, whole = traced(SHOWROOM, parts, choice_of=learned_choice), traced(SHOWROOM, None, choice_of=learned_choice)
    first = parts.cumsum(0) - parts
    assert len(split.lights.cluster) == int(parts.sum())
    assert torch.equal(split.lights.cluster[first], whole.lights.cluster)
    assert torch.equal(split.lights.contribution_rms[first], whole.lights.contribution_rms)


def test_emission_of_the_primary_hit_counts_once():
    glowing = matte(0.5, emission=(1.0, 2.0, 3.0))
    alone = scene([rectangle(0)], [glowing], max_depth=4)
    samples = traced(alone, 7, ((0.0, 0.0, 1.0), (0.1, 0.0, -1.0)), count=100).samples
    assert torch.equal(samples.radiance, torch.tensor([1.0, 2.0, 3.0])[:, None].expand(3, 100))
    assert torch.equal(samples.emission, samples.radiance)


def test_rays_without_a_hit_and_dead_rays_do_not_split():
    lit = scene([rectangle(0)], [matte(0.5)], sky(1.0), max_depth=3)
    tracer, count = PathTracer(lit), 1000
    origin = torch.tensor([0.0, 0.0, 1.0])[:, None].repeat(1, count)
    direction = torch.nn.functional.normalize(torch.randn(3, count, generator=torch.Generator().manual_seed(2)), dim=0)
    parts, index = torch.arange(count) % 4 + 1, torch.arange(0, count, 3)
    random = PixelRandom(0, 1, torch.arange(count))
    alive = torch.zeros(count).index_fill(0, index, 0.5)
    found = tracer.trace(origin, direction, random, PhaseTimer(), alive=alive, splitting=SplitPaths(parts)).radiance
    expected = tracer.trace(origin, direction, random, PhaseTimer(), splitting=SplitPaths(parts)).radiance
    assert torch.equal(found[:, index], expected[:, index])
    assert not found.index_fill(1, index, 0.0).any()
    missed = direction[2] >= 0.0
    assert (expected[:, missed] == 1.0).all() and int(missed.sum()) > 400


def test_a_mirror_shows_the_same_image_to_all_parts():
    """An emitter before a flat mirror has its virtual image as far behind the mirror."""
    polished = Material("polished", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
    mirrored = scene([rectangle(0, rotate=UP), rectangle(1, (0.0, 2.0, 0.0), DOWN)], [polished, emitter(double_sided=True)])
    ray = ((0.3, 1.0, 0.0), (0.0, -1.0, 0.0))
    samples = traced(mirrored, 5, ray, count=100)
    torch.testing.assert_close(samples.samples.distance, torch.full((100,), 1.0), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(samples.image, torch.full((100,), 3.0), rtol=1e-2, atol=0.0)


def test_the_numbers_of_copies_are_uniform_and_independent():
    random, pixels = PixelRandom(0, 1, torch.arange(1 << 18)), 1 << 18
    numbers = [random.copies(torch.full((pixels,), copy)).uniform(32, 1)[0].numpy() for copy in range(4)]
    assert np.array_equal(numbers[0], random.uniform(32, 1)[0].numpy())
    for copy in range(1, 4):
        assert uniformity(numbers[copy]) > SIGNIFICANCE
        assert independence(numbers[copy - 1], numbers[copy]) > SIGNIFICANCE
    assert independence(numbers[1][:-1], numbers[2][1:]) > SIGNIFICANCE
