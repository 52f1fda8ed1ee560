"""Renders that stop where they are good enough: what they save, what they promise, and that they have no bias."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.metrics import mape
from bokehguide.render import split_film
from bokehguide.render.features import MeanFeatures
from bokehguide.render.film import NO_DEPTH, Film, FilmSamples
from bokehguide.render.halves_film import HalfFilm, HalvesFilm
from bokehguide.render.vector import luminance
from bokehguide.train import AdaptiveLoop, RenderLoop, RenderSettings, adaptive, load_checkpoint, make_loop, save_checkpoint
from tests.support import scenes
from tests.support.sharing_cases import spoil
from tests.support.statistical import SIGNIFICANCE, z_test

WIDTH, HEIGHT = 64, 40


def rendered(scene, spp, **settings):
    loop = make_loop(scene, RenderSettings(spp=spp, threads=1, **settings))
    while loop.step_number < spp and not loop.finished:
        loop.step()
    return loop


def mean_luminance(picture):
    return float(luminance(picture.radiance().double().reshape(-1, 3).T).mean())


def test_blocks_stop_at_the_target_and_noisy_ones_go_on(monkeypatch):
    monkeypatch.setattr(adaptive, "BLOCK", 8)
    scene = scenes.emitters(WIDTH, HEIGHT)
    loop = rendered(scene, 256, mode="lis", target_noise=0.1)
    counts = torch.from_numpy(loop.picture().layers()["sample_count"])
    blocks = counts.unfold(0, 8, 8).unfold(1, 8, 8).flatten(2)
    assert bool((blocks == blocks[..., :1]).all()), "a block stops as a whole"
    assert set(counts.unique().tolist()) <= {first + other for first in (16, 32, 64, 128) for other in (16, 32, 64, 128)}
    assert counts.min() == 32 and counts.max() > 100
    truth = RenderLoop(scene, RenderSettings("guided", seed=9, threads=1))
    for _ in range(256):
        truth.step()
    error = (loop.picture().radiance() - truth.film.radiance()).abs() / (truth.film.radiance() + 0.01)
    assert float(error.mean()) < 0.1
    equal = RenderLoop(scene, RenderSettings("lis", seed=5, threads=1))
    for _ in range(round(float(counts.mean()))):
        equal.step()
    assert (
        float(error.square().mean())
        < ((equal.film.radiance() - truth.film.radiance()) / (truth.film.radiance() + 0.01)).square().mean()
    )


@pytest.mark.slow
def test_the_estimate_is_near_the_true_error():
    """Independent pairs of halves: what their differences tell, against the errors of their means."""
    scene = scenes.emitters(WIDTH, HEIGHT)
    truth = RenderLoop(scene, RenderSettings("guided", seed=9, threads=1))
    for _ in range(512):
        truth.step()
    told, true = [], []
    for seed in range(4):
        loop = AdaptiveLoop(scene, RenderSettings("lis", seed=seed, threads=1, target_noise=1e-6))
        for _ in range(64):
            loop.step()
        told.append(loop.picture().relative_noise())
        true.append(mape(loop.picture().radiance(), truth.film.radiance()))
    assert np.mean(told) == pytest.approx(np.mean(true), rel=0.15)


class SelfDeciding(AdaptiveLoop):
    """What must not be: each half stops where its own samples look good."""

    def _close(self, errors):
        super()._close(errors.flip(0))


def bias(monkeypatch, kind, mode):
    """z of the mean over many renders of few samples, most of which miss what is bright."""
    monkeypatch.setattr(adaptive, "BLOCK", 4)
    monkeypatch.setattr(adaptive, "FIRST_ROUND", 1)
    scene = scenes.emitters(48, 32)
    truth = RenderLoop(scene, RenderSettings("guided", seed=99, threads=1))
    for _ in range(1024):
        truth.step()
    means = []
    for seed in range(40):
        loop = kind(scene, RenderSettings(mode, seed=seed, threads=1, target_noise=0.05))
        while loop.step_number < 16 and not loop.finished:
            loop.step()
        means.append(mean_luminance(loop.picture()))
    error = np.std(means, ddof=1) / math.sqrt(len(means))
    spread = math.sqrt(float(truth.film.variance().double().mean()) / (48 * 32))
    return z_test(np.mean(means) - mean_luminance(truth.film), math.hypot(error, spread))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["uniform", "guided"])
def test_stopping_brings_no_bias(mode, monkeypatch):
    assert bias(monkeypatch, AdaptiveLoop, mode) > SIGNIFICANCE


@pytest.mark.slow
def test_deciding_for_oneself_does(monkeypatch):
    assert bias(monkeypatch, SelfDeciding, "uniform") < SIGNIFICANCE


def test_resuming_gives_the_same_bits(tmp_path, monkeypatch):
    monkeypatch.setattr(adaptive, "BLOCK", 8)
    scene = scenes.emitters(WIDTH, HEIGHT)
    settings = RenderSettings("lis-b", spp=100, threads=1, target_noise=0.1)
    whole = AdaptiveLoop(scene, settings)
    for step in range(1, 101):
        whole.step()
        if step == 71:
            save_checkpoint(tmp_path / "a.ckpt", whole, 1.5)
    independent = AdaptiveLoop(scene, settings)
    assert load_checkpoint(tmp_path / "a.ckpt", independent) == 1.5 and independent.step_number == 71
    for _ in range(29):
        independent.step()
    for name, layer in whole.picture().layers().items():
        np.testing.assert_array_equal(independent.picture().layers()[name], layer, err_msg=name)
    other = AdaptiveLoop(scene, replace(settings, target_noise=0.2))
    with pytest.raises(BokehguideError, match=r"target_noise was 0.1 and is 0.2"):
        load_checkpoint(tmp_path / "a.ckpt", other)


@pytest.mark.parametrize("height, width", [(40, 64), (33, 31), (5, 3)])
def test_blocks_and_back(height, width):
    image = torch.rand(height, width, dtype=torch.float64)
    blocks = adaptive.to_blocks(image[None])[0]
    assert torch.equal(adaptive.from_blocks(blocks, height, width), image)
    assert torch.equal(blocks[0, :height, :width], image[: adaptive.BLOCK, : adaptive.BLOCK])


def test_what_a_half_says_of_a_block_hangs_on_that_block_alone(monkeypatch):
    """Beside it a block may have ended, at a time that the other half chose."""
    monkeypatch.setattr(adaptive, "BLOCK", 8)
    errors = []
    for beyond in (1.0, 0.01):
        half = AdaptiveLoop(scenes.emitters(WIDTH, HEIGHT), RenderSettings("uniform", threads=1, target_noise=0.1)).halves[0]
        half.step_number = 16
        half.brightness.copy_(torch.rand(2, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(3)))
        half.brightness.view(2, HEIGHT, WIDTH)[:, :, 8:] *= beyond
        errors.append(half.end_round().reshape(HEIGHT, WIDTH))
    assert torch.equal(errors[0][:, :8], errors[1][:, :8]) and not torch.equal(errors[0][:, 8:], errors[1][:, 8:])


@pytest.mark.parametrize("mode", ["uniform", "lis-b", "guided"])
def test_a_half_decides_by_what_is_on_the_film(mode):
    """Where all of its samples are."""
    half = adaptive.HalfLoop(scenes.emitters(WIDTH, HEIGHT), RenderSettings(mode, seed=3, threads=1), None)
    for _ in range(9):
        half.step()
    picture = luminance(half.film.radiance().reshape(-1, 3).T).double()
    torch.testing.assert_close(half.brightness.sum(0) / 9, picture, rtol=1e-5, atol=1e-7)
    total, count = half._light_so_far()
    assert total / count == pytest.approx(half.film.mean_luminance(), rel=1e-5)


def test_the_error_of_a_round_compares_it_with_all_rounds_before():
    """Of the mean of both halves: √2 less than the error of one."""
    half = adaptive.HalfLoop(scenes.emitters(32, 32), RenderSettings("uniform", threads=1), None)
    first, second, third = torch.rand(3, 32, 32, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    half.step_number, half.brightness = 16, torch.stack((8.0 * first, 8.0 * second)).reshape(2, -1)
    expected = split_film.relative_error(first[None], second[None]).flatten() / math.sqrt(2.0)
    torch.testing.assert_close(half.end_round(), expected)
    half.step_number = 32
    half.brightness[1] += 16.0 * third.flatten()
    expected = split_film.relative_error(0.5 * (first + second)[None], third[None]).flatten() / math.sqrt(2.0)
    torch.testing.assert_close(half.end_round(), expected)


def test_a_sample_that_is_not_finite_has_no_brightness():
    half = adaptive.HalfLoop(scenes.emitters(WIDTH, HEIGHT), RenderSettings("uniform", threads=1), None)
    spoil(half, 5)
    bad = half.film.layers()["sample_count"].flatten() == 0.0
    assert bad.any() and torch.equal(half.brightness[1] == 0.0, torch.from_numpy(bad))


def film_of(depths: list[float], light: tuple[float, float]) -> Film:
    """A film of one row of pixels at these depths, after two samples of these radiances."""
    count = len(depths)
    film = Film(count, 1, features=MeanFeatures)
    ones, none = torch.ones(count), torch.zeros(3, count)
    for step, radiance in enumerate(light, start=1):
        film.add(slice(0, count), FilmSamples(ones, none + radiance, ones, torch.tensor(depths), none, none, none), step)
    return film


def test_the_layers_of_both_halves_are_those_of_all_samples():
    one, two = film_of([1.0, 2.0, NO_DEPTH, NO_DEPTH], (1.0, 3.0)), film_of([3.0, NO_DEPTH, 5.0, NO_DEPTH], (2.0, 6.0))
    layers = HalvesFilm(one, two).layers()
    np.testing.assert_allclose(layers["depth"], [[2.0, 2.0, 5.0, NO_DEPTH]])
    np.testing.assert_allclose(layers["beauty"], 3.0)
    np.testing.assert_allclose(layers["sample_count"], 4.0)
    np.testing.assert_allclose(layers["variance"], 0.25 * (1.0 + 4.0), rtol=1e-6)


def test_a_highlight_of_one_pixel_has_the_error_of_its_neighbourhood():
    first, second = torch.ones(2, 1, 9, 9)
    first[0, 4, 4] = 101.0
    about = (24.0 + 51.0) / split_film.POOLED**2
    assert float(split_film.relative_error(first, second)[0, 4, 4]) == pytest.approx(50.0 / (about + 0.01))


def test_rounds_double_in_length(monkeypatch):
    monkeypatch.setattr(adaptive, "FIRST_ROUND", 2)
    loop, ends = AdaptiveLoop(scenes.emitters(8, 5), RenderSettings("uniform", threads=1, target_noise=0.1)), []
    loop._end_round = ends.append
    for _ in range(40):
        loop.step()
    assert ends == [2, 4, 8, 16]


def test_blocks_at_the_right_edge_are_blocks_of_their_own():
    loop = AdaptiveLoop(scenes.emitters(40, 36), RenderSettings("uniform", threads=1, target_noise=0.1))
    assert loop.open.shape == (2, 4)


def test_the_film_of_a_half_is_the_first_of_two_pictures():
    """One share for each pixel, also of a frame that is not square."""
    halves = HalfFilm(5, 3).halves()
    assert torch.equal(halves.share, torch.ones(3, 5)) and not halves.second.any()


def test_the_expected_steps_follow_the_worst_open_block():
    """The error falls with the root of the steps: a third of the error needs 9 times the steps, in rounds that double."""
    loop = AdaptiveLoop(scenes.emitters(40, 36), RenderSettings("uniform", threads=1, target_noise=0.1))
    for half in loop.halves:
        half.step_number = 32
    loop._close(torch.tensor([[0.05, 0.3, 0.2, 0.05], [0.05, 0.05, 0.05, 0.01]]))
    assert loop.open.tolist() == [[False] * 4, [False, True, True, False]]
    assert loop.expected_steps == 16 * 64
    loop._close(torch.tensor([[0.9, 0.1, 0.11, 0.9], [0.9] * 4]))
    assert loop.open.tolist() == [[False] * 4, [False, False, True, False]]
    assert loop.expected_steps == 2 * 64


def test_a_half_of_a_denoised_render_has_no_halves():
    loop = AdaptiveLoop(scenes.emitters(32, 18), RenderSettings(threads=1, target_noise=0.01, denoise=True))
    assert [type(half.film) for half in loop.halves] == [HalfFilm, HalfFilm]


def test_halves_share_nothing_random_but_all_else():
    loop = AdaptiveLoop(scenes.emitters(WIDTH, HEIGHT), RenderSettings("uniform", threads=1, target_noise=0.1))
    for _ in range(2):
        loop.step()
    first, second = (half.film.radiance().amax(-1) for half in loop.halves)
    lit = first + second > 0.3  # the sky is 0.1 everywhere: what is brighter has seen an emitter
    assert lit.sum() > 20 and float((first != second)[lit].float().mean()) > 0.8
    assert loop.halves[0].tracer is loop.halves[1].tracer


@pytest.mark.parametrize(
    "values, message",
    [
        ({"target_noise": 0.0}, "target_noise: 0.0 is out of range"),
        ({"target_noise": 2.0}, "target_noise: 2.0 is out of range"),
        ({"target_noise": math.nan}, "target_noise: nan is out of range"),
        ({"target_noise": 0.1, "mode": "area-restir"}, "target_noise: area-restir reuses"),
    ],
)
def test_bad_targets_are_refused(values, message):
    with pytest.raises(BokehguideError, match=message):
        RenderSettings(**values)
