"""A learnt choice of lights: the table it is made of, the clusters it is among, and paths that follow it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bokehguide.render.clusters import ClusterTable, gather
from bokehguide.render.environment import EnvironmentLight
from bokehguide.render.light_choice import LightChoice, LightClusters
from bokehguide.render.lights import Lights
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.scene.types import Environment, Scene, Sun
from tests.statistical import SIGNIFICANCE, chi_square
from tests.test_render_lights import DRAWS, lamps, learnt_choice, sampled, window
from tests.test_render_mis import MATERIALS, room, sky_with_a_window
from tests.tracing import agreement, estimates, lamp, matte

RAY = ((0.1, 1.3, 1.5), (-0.1, -0.8, -1.5))
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
    """Two far groups of lamps are parted before either is split, and no more clusters than there are lamps."""
    features = np.array([[0.0], [0.1], [0.2], [9.0], [9.1]])
    cluster, count = gather(features, np.ones(5))
    assert count == 5 and len(set(cluster)) == 5
    cluster, count = gather(np.repeat(features, 200, axis=0) + np.linspace(0.0, 1e-3, 1000)[:, None], np.ones(1000))
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
    element = clusters.pick(number, PixelRandom(1, 0, torch.arange(len(number))).uniform(0, 2))
    assert torch.equal(clusters.cluster(element), number)
    drawn = light.pick(PixelRandom(2, 0, torch.arange(DRAWS)).uniform(0, 3))
    found = clusters.cluster(drawn)
    assert found.min() >= 0 and found.max() < clusters.count


def test_texels_are_drawn_from_their_cluster_by_power():
    light = LIGHTS["map"]
    clusters, shares = LightClusters(None, light), torch.from_numpy(light.map.shares().astype(np.float64)).flatten()
    texels = torch.arange(len(shares))
    of_texel = clusters.cluster(texels)
    assert clusters.count == 128 and len(of_texel.unique()) == 128
    for cluster in (0, 50, 127):
        inside = torch.where(of_texel == cluster, shares, 0.0)
        drawn = clusters.pick(torch.full((DRAWS,), cluster), PixelRandom(5, 0, torch.arange(DRAWS)).uniform(0, 2))
        expected = inside / inside.sum()
        assert chi_square(drawn.bincount(minlength=len(shares)).numpy(), expected.numpy()) > SIGNIFICANCE
        within = clusters.pdf_within(texels)[of_texel == cluster].double() / light.map.evenness()[of_texel == cluster]
        np.testing.assert_allclose(within, expected[of_texel == cluster], rtol=1e-5)


def test_a_map_with_nothing_to_sample_has_no_clusters():
    even = EnvironmentLight(Environment(np.full((4, 8, 3), 0.5, np.float32)), SUNS)
    assert LightClusters(None, even).count == 2


@pytest.mark.parametrize("learnt", [False, True])
def test_a_sample_tells_its_cluster_and_how_likely_that_was(learnt):
    """Also where nothing is learnt yet: it is what is learnt from."""
    lights, _, choice, light = sampled(lamps(window()), learnt=True)
    if not learnt:
        choice = LightChoice(choice.row, None, 1)
        uniforms = PixelRandom(0, 0, torch.arange(DRAWS)).uniform(0, 6)
        light = lights.sample(torch.zeros(3, DRAWS), uniforms, choice)
    for row in range(3 if learnt else 1):
        chosen = choice.row == row if learnt else torch.ones(DRAWS, dtype=torch.bool)
        cluster, share = light.cluster[chosen], light.share[chosen].double()
        count = lights.clusters.count
        number = cluster.bincount(minlength=count)
        expected = torch.zeros(count, dtype=torch.float64).index_add_(0, cluster, share) / number.clamp(min=1)
        assert float((share / expected[cluster] - 1.0).abs().max()) < 1e-3  # the same for all of a cluster
        assert float(expected.sum()) == pytest.approx(1.0, abs=1e-2)  # but for those that were never drawn
        assert chi_square(number.numpy(), (expected / expected.sum()).numpy()) > SIGNIFICANCE


def following(choice_of, lit: Scene, count: int = 60_000) -> np.ndarray:
    """Estimates `[3, count]` along RAY by paths that follow a choice."""
    tracer = PathTracer(lit)
    origin = torch.tensor(RAY[0])[:, None].repeat(1, count)
    direction = torch.nn.functional.normalize(torch.tensor(RAY[1])[:, None].repeat(1, count), dim=0)
    random = PixelRandom(0, 1, torch.arange(count))
    choice = choice_of(tracer.lights, count)
    return tracer.trace(origin, direction, random, PhaseTimer(), choose=lambda _: choice).radiance.double().numpy()


@pytest.mark.parametrize("name", ["matte", "glossy metal", "frosted sheet"])
def test_whatever_is_chosen_the_mean_is_the_same(name):
    lit = room(MATERIALS[name], sky_with_a_window(6.0), lamp(2.0))
    plain = estimates(lit, *RAY, count=120_000, seed=1)
    assert agreement(following(learnt_choice, lit), plain) > SIGNIFICANCE


FORGETFUL = {
    "triangle_pdf": (5, room(MATERIALS["glossy metal"], None, lamp(2.0))),
    "environment_pdf": (3, room(MATERIALS["glossy metal"], starry(), matte(0.2))),
}


@pytest.mark.parametrize("density", FORGETFUL)
def test_a_weight_that_does_not_know_the_choice_is_found(density, monkeypatch):
    known, lit = FORGETFUL[density]
    plain = estimates(lit, *RAY, count=200_000, seed=1)
    assert agreement(following(learnt_choice, lit, 200_000), plain) > SIGNIFICANCE
    whole = getattr(Lights, density)
    monkeypatch.setattr(Lights, density, lambda *arguments: whole(*arguments[:known]))
    assert agreement(following(learnt_choice, lit, 200_000), plain) < SIGNIFICANCE
