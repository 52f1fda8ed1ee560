"""A learnt choice of lights: the table it is made of, the clusters it is among, and paths that follow it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bokehguide.guiding.cluster_lights import MixtureLights, VoxelLights
from bokehguide.render.lights.clusters import ClusterTable, build_clusters
from bokehguide.render.lights.environment import EnvironmentLight
from bokehguide.render.lights.light_clusters import LightClusters
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Environment, Scene, Sun
from tests.support.choice_cases import COUNTS, ROOM_RAY, Everywhere, learned_choice, traced
from tests.support.light_cases import DRAWS, emitters, sampled, window
from tests.support.rooms import MATERIALS, room, sky_with_a_window
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test
from tests.support.tracing import agreement, emitter, estimates, matte

SUNS = (Sun((0.6, 0.8, 0.0), 8.0, (2.0, 2.0, 2.0)), Sun((0.0, -0.6, -0.8), 12.0, (1.0, 1.0, 0.5)))


def table_of(rows: int, count: int) -> np.ndarray:
    """Probabilities over many decades, some 0, `[rows, count]`."""
    weights = np.random.default_rng(count).lognormal(0.0, 2.0, (rows, count))
    weights[:, 5::4] = 0.0
    return weights / weights.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("count", [2, 3, 100, 128, 129, 256])
def test_clusters_are_drawn_as_the_table_says(count):
    """In the middle one of three rows; and the probabilities of all rows sum to one."""
    expected = table_of(3, count)
    table = ClusterTable(torch.from_numpy(expected))
    row = torch.ones(DRAWS, dtype=torch.int32)
    drawn = table.sample(row, PixelRandom(3, 0, torch.arange(DRAWS)).uniform(0, 1)[0])
    assert chi_square(np.bincount(drawn.numpy(), minlength=count), expected[1]) > SIGNIFICANCE
    found = table.pdf(torch.arange(3).repeat_interleave(count), torch.arange(count).repeat(3)).reshape(3, count)
    np.testing.assert_allclose(found.double().sum(1), 1.0, atol=1e-6)
    np.testing.assert_allclose(found, expected, atol=2e-7)


def test_of_one_cluster_there_is_nothing_to_choose():
    table = ClusterTable(torch.ones(2, 1, dtype=torch.float64))
    row = torch.tensor([0, 1], dtype=torch.int32)
    assert table.sample(row, torch.tensor([0.0, 1.0 - 2.0**-24])).tolist() == [0, 0]
    assert table.pdf(row, torch.zeros_like(row)).tolist() == [1.0, 1.0]


def test_like_lights_are_gathered():
    """Two far groups of emitters are parted before either is split, and no more clusters than there are emitters."""
    features = np.array([[0.0], [0.1], [0.2], [9.0], [9.1]])
    cluster, count = build_clusters(features, np.ones(5))
    assert count == 5 and len(set(cluster)) == 5
    cluster, count = build_clusters(np.repeat(features, 200, axis=0) + np.linspace(0.0, 1e-3, 1000)[:, None], np.ones(1000))
    assert count == 128
    assert not set(cluster[:600]) & set(cluster[600:])


def starry() -> Environment:
    """More texels than clusters, of radiances over many decades."""
    return Environment(np.random.default_rng(2).lognormal(0.0, 1.5, (96, 192, 1)).astype(np.float32).repeat(3, axis=2), 20.0)


LIGHTS = {"map": EnvironmentLight(starry()), "suns": EnvironmentLight(None, SUNS), "both": EnvironmentLight(starry(), SUNS)}


@pytest.mark.parametrize("name", LIGHTS)
def test_elements_of_the_environment_belong_to_one_cluster_each(name):
    light = LIGHTS[name]
    clusters = LightClusters(None, light)
    number = torch.arange(clusters.count).repeat_interleave(500)
    element = clusters.sample_element(number, PixelRandom(1, 0, torch.arange(len(number))).uniform(0, 2))
    assert torch.equal(clusters.cluster(element), number)
    drawn = light.sample_element(PixelRandom(2, 0, torch.arange(DRAWS)).uniform(0, 3))
    found = clusters.cluster(drawn)
    assert found.min() >= 0 and found.max() < clusters.count


@pytest.mark.parametrize("name", ["suns", "both"])
def test_the_density_of_a_distant_light_within_its_cluster_is_one_over_its_solid_angle(name):
    clusters = LightClusters(None, LIGHTS[name])
    expected = [1.0 / (2.0 * math.pi * (1.0 - math.cos(math.radians(sun.angle) / 2.0))) for sun in SUNS]
    np.testing.assert_allclose(clusters.pdf_within(torch.tensor([-1, -2])), expected, rtol=1e-5)


def test_texels_are_drawn_from_their_cluster_by_power():
    light = LIGHTS["map"]
    clusters, shares = LightClusters(None, light), torch.from_numpy(light.map.shares().astype(np.float64)).flatten()
    texels = torch.arange(len(shares))
    of_texel = clusters.cluster(texels)
    assert clusters.count == 128 and len(of_texel.unique()) == 128
    for cluster in (0, 50, 127):
        inside = torch.where(of_texel == cluster, shares, 0.0)
        drawn = clusters.sample_element(torch.full((DRAWS,), cluster), PixelRandom(5, 0, torch.arange(DRAWS)).uniform(0, 2))
        expected = inside / inside.sum()
        assert chi_square(drawn.bincount(minlength=len(shares)).numpy(), expected.numpy()) > SIGNIFICANCE
        within = clusters.pdf_within(texels)[of_texel == cluster].double() / light.map.uniform_density()[of_texel == cluster]
        np.testing.assert_allclose(within, expected[of_texel == cluster], rtol=1e-5)


def test_a_map_with_nothing_to_sample_has_no_clusters():
    even = EnvironmentLight(Environment(np.full((4, 8, 3), 0.5, np.float32)), SUNS)
    assert LightClusters(None, even).count == 2


@pytest.mark.parametrize("learnt", [False, True])
def test_a_sample_tells_its_cluster_and_how_likely_that_was(learnt):
    """Also where nothing is learnt yet: it is what is learnt from."""
    power, *_, light = sampled(emitters(window()), learnt=True)
    lights, rows = power.lights, torch.arange(DRAWS) % 3
    if not learnt:
        uniforms = PixelRandom(0, 0, torch.arange(DRAWS)).uniform(0, 6)
        light = VoxelLights(power, rows.int(), COUNTS).draw(lights.query(torch.zeros(3, DRAWS)), uniforms)
    for row in range(3 if learnt else 1):
        chosen = rows == row if learnt else torch.ones(DRAWS, dtype=torch.bool)
        cluster, share = light.cluster[chosen], light.share[chosen].double()
        count = lights.clusters.count
        number = cluster.bincount(minlength=count)
        expected = torch.zeros(count, dtype=torch.float64).index_add_(0, cluster, share) / number.clamp(min=1)
        assert float((share / expected[cluster] - 1.0).abs().max()) < 1e-3  # the same for all of a cluster
        assert float(expected.sum()) == pytest.approx(1.0, abs=1e-2)  # but for those that were never drawn
        assert chi_square(number.numpy(), (expected / expected.sum()).numpy()) > SIGNIFICANCE


def following(choice_of, lit: Scene, count: int = 60_000) -> np.ndarray:
    """Estimates `[3, count]` along ROOM_RAY by paths that follow a choice."""
    tracer = PathTracer(lit)
    origin = torch.tensor(ROOM_RAY[0])[:, None].repeat(1, count)
    direction = torch.nn.functional.normalize(torch.tensor(ROOM_RAY[1])[:, None].repeat(1, count), dim=0)
    random = PixelRandom(0, 1, torch.arange(count))
    sampler = Everywhere(lambda _: choice_of(tracer.light_sampler, count))
    return tracer.trace(origin, direction, random, PhaseTimer(), light_sampler=sampler).radiance.double().numpy()


@pytest.mark.parametrize("name", ["matte", "glossy metal", "frosted sheet"])
def test_whatever_is_chosen_the_mean_is_the_same(name):
    lit = room(MATERIALS[name], sky_with_a_window(6.0), emitter(2.0))
    plain = estimates(lit, *ROOM_RAY, count=120_000, seed=1)
    assert agreement(following(learned_choice, lit), plain) > SIGNIFICANCE


@pytest.mark.parametrize("name", ["lamp", "map"])
@pytest.mark.parametrize("material", ["matte", "glossy metal", "frosted sheet"])
def test_the_mean_of_the_difference_between_both_techniques_is_zero(material, name):
    """Of broad light (`mis_factors`), with shadows; and the difference is not zero itself."""
    lit = room(MATERIALS[material], *((None, emitter(2.0)) if name == "lamp" else (sky_with_a_window(6.0), matte(0.2))))
    difference = traced(lit, ROOM_RAY, 120_000, split=True).lights.samples[0].difference.double()
    error = difference.std() / math.sqrt(len(difference))
    assert float(error) > 0.0
    assert z_test(difference.mean()[None].numpy(), error[None].numpy()) > SIGNIFICANCE


FORGETFUL = {
    "triangle_pdf": room(MATERIALS["glossy metal"], None, emitter(2.0)),
    "environment_pdf": room(MATERIALS["glossy metal"], starry(), matte(0.2)),
}


@pytest.mark.parametrize("density", FORGETFUL)
def test_a_weight_that_does_not_know_the_choice_is_found(density, monkeypatch):
    lit = FORGETFUL[density]
    plain = estimates(lit, *ROOM_RAY, count=200_000, seed=1)
    assert agreement(following(learned_choice, lit, 200_000), plain) > SIGNIFICANCE
    monkeypatch.setattr(MixtureLights, density, lambda self, *arguments: getattr(self._power, density)(*arguments))
    assert agreement(following(learned_choice, lit, 200_000), plain) < SIGNIFICANCE
