"""The roulette of shadow rays: exact means, thresholds from the film, and agreement of the native core with PyTorch."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render.film import Film, FilmSamples
from bokehguide.render.lights.base import ClusterRecord, DirectLight
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.shadow_roulette import MIN_CHANCE, SHARE, ShadowRoulette, roulette_factor
from bokehguide.runtime import native
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.guided_traces import COUNT, FLIPS, Traced, differing
from tests.support.native_cases import both_tracers, feature_scene, rays

LAMPS = "fairy-lights"


def uniforms(count: int, seed: int = 1) -> torch.Tensor:
    return torch.rand(count, generator=torch.Generator().manual_seed(seed))


def film_of(radiance: torch.Tensor, width: int, height: int) -> Film:
    """A film with one sample for each pixel from each row of grey radiance `[samples, pixels]`."""
    film, pixels = Film(width, height), width * height
    none, zeros = torch.ones(pixels), torch.zeros(3, pixels)
    for step, row in enumerate(radiance, 1):
        film.add(slice(0, pixels), FilmSamples(none, row.expand(3, -1).contiguous(), none, none, zeros, zeros, zeros), step)
    return film


@pytest.mark.parametrize("light", (0.001, 0.1, 0.3, 0.6, 0.99))
def test_factors_have_the_mean_1(light):
    """z-test of 100,000 draws; the least probability limits the factors."""
    factor = roulette_factor(torch.full((100_000,), light), torch.ones(100_000), uniforms(100_000))
    error = factor.double().std() / len(factor) ** 0.5
    assert abs(float(factor.double().mean()) - 1.0) < 4.0 * error
    assert bool((factor == 0.0).any()) and float(factor.max()) == pytest.approx(1.0 / max(light, MIN_CHANCE))


def test_bright_samples_survive_unchanged():
    light = torch.tensor([1.0, 1.5, 1e30, torch.inf, 0.2, 0.0, torch.nan])
    threshold = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0])
    assert torch.equal(roulette_factor(light, threshold, torch.full((7,), 1.0 - 2.0**-24)), torch.ones(7))


def test_thinned_samples_keep_their_expected_moments():
    """The value, and the square of the contribution by which clusters are learned; ended samples have no cluster."""
    count, ones = 100_000, torch.ones(100_000)
    clusters = ClusterRecord(torch.zeros(count, dtype=torch.int32), torch.full((count,), 7, dtype=torch.int32), 3.0 * ones, ones)
    light = DirectLight(torch.zeros(3, count), ones, 2.0 * torch.ones(3, count), ones, torch.zeros(count), clusters)
    factor = roulette_factor(0.4 * ones, ones, uniforms(count))
    thinned = light.thinned(factor)
    assert float(thinned.value.mean()) == pytest.approx(2.0, rel=0.02)
    assert float(thinned.clusters.contribution_rms.square().mean()) == pytest.approx(9.0, rel=0.02)
    assert torch.equal(thinned.clusters.cluster == -1, factor == 0.0) and torch.equal(thinned.clusters.row, clusters.row)
    assert replace(light, clusters=None).thinned(factor).clusters is None


@pytest.mark.parametrize("cell", (1, 4))
def test_thresholds_are_the_least_deviation_of_each_cell(cell):
    """Against plain loops, on a film whose size is no multiple of the cell."""
    width, height = 10, 7
    samples = torch.rand(5, width * height, generator=torch.Generator().manual_seed(2))
    roulette = ShadowRoulette(width, height, cell)
    roulette.update(film_of(samples, width, height))
    deviation = SHARE * samples.double().numpy().reshape(5, height, width).std(0, ddof=1)
    for y in range(height):
        for x in range(width):
            top, left = y // cell * cell, x // cell * cell
            least = deviation[top : top + cell, left : left + cell].min()
            np.testing.assert_allclose(float(roulette.threshold[y * width + x]), least, rtol=1e-4)


def test_thresholds_need_two_samples_and_stay_finite():
    roulette = ShadowRoulette(4, 3, cell=1)
    roulette.update(film_of(torch.rand(1, 12), 4, 3))
    assert not bool(roulette.threshold.any())
    roulette.update(film_of(torch.tensor([[1e30], [0.0]]).expand(2, 12), 4, 3))
    assert bool(roulette.threshold.isfinite().all()) and bool((roulette.threshold > 1e15).all())


def test_thresholds_are_for_light_over_the_weight_of_the_lens_point():
    roulette = ShadowRoulette(4, 1, cell=1)
    roulette.threshold.copy_(torch.tensor([1.0, 2.0, 3.0, 0.0]))
    found = roulette.thresholds(torch.tensor([2, 0, 3]), torch.tensor([2.0, 0.5, 0.0]))
    assert torch.equal(found, torch.tensor([1.5, 2.0, 0.0]))
    assert ShadowRoulette(4, 1, cell=0).thresholds(slice(0, 4), torch.ones(4)) is None


@pytest.mark.parametrize("form", ("native", "PyTorch"))
@pytest.mark.parametrize("splits", (False, True))
def test_the_roulette_keeps_the_mean_of_traces(form, splits, monkeypatch):
    """z-test of differences to the same paths without roulette; one ray in twenty or more is saved."""
    if form == "PyTorch" and not splits:  # also where the core is not built
        monkeypatch.setenv(native.SWITCH, "0")
        tracer = PathTracer(feature_scene(LAMPS))
    else:
        tracer = both_tracers(LAMPS)[form == "PyTorch"]
    given = rays(LAMPS, 20_000)

    def traced(threshold):
        if splits:
            return Traced(tracer, LAMPS, given, shadow_threshold=threshold).samples
        return tracer.trace(*given, PhaseTimer(), shadow_threshold=threshold)

    plain = traced(None)
    thinned = traced(torch.full((20_000,), float(plain.radiance.mean())))
    assert thinned.rays < 0.95 * plain.rays
    change = (thinned.radiance - plain.radiance).double().sum(0)
    assert abs(float(change.mean())) < 4.0 * float(change.std()) / 20_000**0.5 and bool(change.any())
    unchanged = traced(torch.zeros(20_000))
    assert torch.equal(unchanged.radiance, plain.radiance) and unchanged.rays == plain.rays


@pytest.mark.parametrize("name", (LAMPS, "chrome", "lamps", "glass"))
def test_native_and_pytorch_roulettes_agree(name):
    """Radiance, and the records from which clusters of lights are learned."""
    plain = Traced(both_tracers(name)[0], name, rays(name, COUNT))
    threshold = 2.0 * plain.samples.radiance.mean() * uniforms(COUNT)
    native, reference = (Traced(tracer, name, rays(name, COUNT), shadow_threshold=threshold) for tracer in both_tracers(name))
    assert differing(native.samples.radiance, reference.samples.radiance) <= 4.0 * FLIPS
    found, expected = native.lights.samples[0], reference.lights.samples[0]
    assert (found.cluster != expected.cluster).float().mean() <= 2.0 * FLIPS
    assert differing(found.contribution_rms, expected.contribution_rms) <= 2.0 * FLIPS
    ended = (found.cluster == -1) & (plain.lights.samples[0].cluster >= 0)
    assert ended.float().mean() > 0.05


@pytest.mark.parametrize("mode", ("uniform", "lis-o", "guided"))
def test_renders_save_shadow_rays_from_the_third_step_on(mode):
    scene = load_scene(LAMPS, Overrides(width=64, height=36))
    with RenderLoop(scene, RenderSettings(mode)) as loop, RenderLoop(scene, RenderSettings(mode)) as plain:
        plain.shadow_roulette = ShadowRoulette(64, 36, cell=0)
        assert [loop.step().rays == plain.step().rays for _ in range(2)] == [True, True]
        assert torch.equal(loop.film.radiance(), plain.film.radiance())
        assert loop.step().rays < plain.step().rays


def test_steps_after_a_checkpoint_have_the_thresholds_of_the_render():
    scene = load_scene(LAMPS, Overrides(width=64, height=36))
    with RenderLoop(scene, RenderSettings("uniform")) as loop, RenderLoop(scene, RenderSettings("uniform")) as other:
        for _ in range(6):  # within an epoch, whose thresholds are not computed again
            loop.step()
        other.load_state_dict(loop.state_dict())
        assert bool(loop.shadow_roulette.threshold.any())
        for each in (loop, other):
            each.step()
        assert torch.equal(loop.film.radiance(), other.film.radiance())
