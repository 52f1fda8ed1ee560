"""A film in halves: epochs of even and of odd numbers, and the bits of a film without halves."""

import numpy as np
import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GuidedConfig
from bokehguide.image.denoise import denoise_halves
from bokehguide.render.film import Film, FilmSamples
from bokehguide.render.split_film import SplitFilm
from bokehguide.train import (
    AdaptiveLoop,
    RenderLoop,
    RenderSettings,
    denoise_picture,
    load_checkpoint,
    make_loop,
    save_checkpoint,
)
from tests.support import scenes
from tests.support.thread_ranks import job

AnyLoop = RenderLoop | AdaptiveLoop
DEFAULT = GuidedConfig()


def samples(radiance: torch.Tensor) -> FilmSamples:
    """Samples of which a quarter is emission."""
    ones, colors = torch.ones(radiance.shape[1]), torch.ones_like(radiance)
    return FilmSamples(2.0 * ones, radiance, ones, ones, colors, colors, radiance / 8, radiance_weight=ones)


def filled(steps: int, bad: bool = False) -> tuple[Film, SplitFilm, torch.Tensor]:
    history = torch.rand(steps, 3, 12, generator=torch.Generator().manual_seed(2))
    if bad:
        history[1, 0, 5] = torch.nan
    films = Film(4, 3), SplitFilm(4, 3)
    for step, radiance in enumerate(history, start=1):
        for film in films:
            film.add(slice(None), samples(radiance.clone()), step)
    return *films, history


def test_halves_are_the_means_of_alternate_epochs():
    plain, film, history = filled(10)
    first, second, share, *emission = film.halves()
    for half, its in zip((first, second), emission):
        torch.testing.assert_close(its, half / 4)
    epochs = history[:1], history[1:2], history[2:4], history[4:8], history[8:]
    torch.testing.assert_close(first, torch.cat(epochs[::2]).mean(0).T.reshape(3, 4, 3))
    torch.testing.assert_close(second, torch.cat(epochs[1::2]).mean(0).T.reshape(3, 4, 3))
    assert torch.equal(share, torch.full((3, 4), 5 / 10))
    assert torch.equal(film.radiance(), plain.radiance())
    for name, layer in plain.layers().items():
        np.testing.assert_array_equal(film.layers()[name], layer)


def test_bad_samples_are_in_neither_half():
    _, film, history = filled(6, bad=True)
    first, second, share, *emission = film.halves()
    assert all(torch.isfinite(half).all() for half in (first, second, *emission))
    torch.testing.assert_close(second.reshape(-1, 3)[5], history[4:, :, 5].mean(0))
    assert float(share.flatten()[5]) == pytest.approx(3 / 5)


def test_one_step_has_one_half():
    _, film, _ = filled(1)
    first, second, share, *_ = film.halves()
    assert bool((share == 1.0).all()) and not second.any() and torch.equal(first, film.radiance())


def test_a_film_without_halves_is_not_denoised():
    with pytest.raises(BokehguideError, match=r"RenderSettings\(denoise=True\)"):
        denoise_picture(Film(4, 3))


def loop(denoise: bool = True, steps: int = 0, guided: GuidedConfig = DEFAULT, target_noise: float | None = None) -> AnyLoop:
    settings = RenderSettings(seed=7, threads=1, denoise=denoise, guided=guided, target_noise=target_noise)
    made = make_loop(scenes.emitters(32, 18), settings)
    for _ in range(steps):
        made.step()
    return made


def test_a_resumed_render_has_the_same_halves(tmp_path):
    one = loop(steps=3)
    save_checkpoint(tmp_path / "a.ckpt", one, 1.0)
    other = loop()
    load_checkpoint(tmp_path / "a.ckpt", other)
    for each in (one, other):
        for _ in range(3):
            each.step()
    for half, its_half in zip(one.film.halves(), other.film.halves()):
        assert torch.equal(half, its_half)
    assert torch.equal(one.film.radiance(), loop(steps=6).film.radiance())


@pytest.mark.parametrize("mode", ["uniform", "lis-o", "guided"])
def test_the_difference_of_the_halves_tells_the_variance_of_stratified_emission(mode):
    """Halves that share epochs would tell 3 times the variance in mode `guided`."""
    pictures, estimates = [], []
    for seed in range(12):
        with RenderLoop(scenes.emitters(32, 18), RenderSettings(mode, seed=seed, threads=1, denoise=True)) as made:
            for _ in range(32):
                made.step()
        halves = made.film.halves()
        share, first, second = halves.share[..., None], halves.first_emission, halves.second_emission
        pictures.append(share * first + (1.0 - share) * second)
        estimates.append(share * (1.0 - share) * (first - second) ** 2)
    assert 0.8 < float(torch.stack(estimates).mean() / torch.stack(pictures).var(0).mean()) < 1.6


@pytest.mark.parametrize("target_noise", [None, 1e-3])
def test_emission_is_a_part_of_the_halves_and_is_denoised_apart(target_noise):
    pytest.importorskip("mitsuba_oidn")
    film = loop(steps=6, target_noise=target_noise).picture()
    first, second, share, *emission = film.halves()
    seen = share[..., None] * emission[0] + (1.0 - share[..., None]) * emission[1]
    layers = film.layers()
    torch.testing.assert_close(seen, torch.from_numpy(layers["emission"]))
    halves = [half.numpy() for half in (first, second, share)]
    arguments = *halves, layers["albedo"], layers["normal"]
    apart = denoise_halves(*arguments, [half.numpy() for half in emission], layers["variance"])
    joint = denoise_halves(*arguments, (), layers["variance"])
    np.testing.assert_array_equal(denoise_picture(film).radiance, apart.radiance)
    assert not np.array_equal(apart.radiance, joint.radiance)


@pytest.mark.parametrize("target_noise", [None, 1e-3])
def test_pixels_of_a_denoised_render_share_no_samples(target_noise):
    def radiance(denoise, **groups):
        return loop(denoise, 6, GuidedConfig(**groups), target_noise).picture().radiance()

    assert torch.equal(radiance(True), radiance(False, reuse_group=1))
    assert torch.equal(radiance(True, denoised_reuse_group=16), radiance(False))
    assert not torch.equal(radiance(True), radiance(False))


def test_a_checkpoint_without_halves_is_refused_in_a_line(tmp_path):
    save_checkpoint(tmp_path / "a.ckpt", loop(denoise=False, steps=1), 1.0)
    with pytest.raises(BokehguideError, match="denoise was False and is True; render without --resume"):
        load_checkpoint(tmp_path / "a.ckpt", loop())


def test_ranks_have_the_halves_of_one():
    expected = loop(steps=4).picture().halves()
    scene, settings = scenes.emitters(32, 18), RenderSettings(seed=7, threads=1, denoise=True)

    def rendered(ranks):
        made = RenderLoop(scene, settings, ranks)
        for _ in range(4):
            made.step()
        return made.picture().halves()

    for found in job(2, rendered):
        for half, its_half in zip(expected, found):
            torch.testing.assert_close(half, its_half, rtol=1e-4, atol=1e-5)
