"""The training loop: what it does when, and that only the seed changes its bits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch

from bokehguide.errors import BokehguideError
from bokehguide.scene.types import Scene
from bokehguide.train import LENS_MODES, RenderLoop, RenderSettings
from bokehguide.train.guide import FITS

STEPS = 11


def scene() -> Scene:
    return scenes.lamps(80, 45)


def rendered(mode: str, threads: int = 1, seed: int = 0) -> RenderLoop:
    loop = RenderLoop(scene(), RenderSettings(mode, seed=seed, threads=threads))
    for _ in range(STEPS):
        loop.step()
    return loop


def assert_same_bits(one: RenderLoop, other: RenderLoop) -> None:
    layers = other.film.layers()
    for name, layer in one.film.layers().items():
        np.testing.assert_array_equal(layer, layers[name], err_msg=name)
    if one.guide is not None:
        state = other.guide.state_dict()
        for name, value in one.guide.state_dict().items():
            assert torch.equal(value, state[name]), name


@pytest.mark.parametrize("mode", LENS_MODES)
def test_any_number_of_threads_gives_the_same_bits(mode, monkeypatch):
    """Of a frame cut into several batches."""
    monkeypatch.setattr("bokehguide.train.batches.SMALL_BATCH", 100)
    one = rendered(mode)
    for threads in (2, 3):
        assert_same_bits(one, rendered(mode, threads))


@pytest.mark.parametrize("mode", ["lis-o", "guided"])
def test_so_it_does_where_few_batches_are_guided(mode, monkeypatch):
    """Lamps in some of them, seen through a lens of which 1 / (A / A) is not 1 in single precision."""
    radius = 0.105
    lens = replace(scenes.lamps(80, 45).camera, aperture_radius=radius)
    area = math.pi * torch.tensor(radius) ** 2
    assert float(1.0 / (area * (1.0 / area))) != 1.0
    monkeypatch.setattr("bokehguide.train.batches.SMALL_BATCH", 100)

    def picture(threads: int) -> RenderLoop:
        loop = RenderLoop(replace(scenes.lamps(80, 45), camera=lens), RenderSettings(mode, threads=threads))
        for _ in range(STEPS):
            loop.step()
        return loop

    one = picture(1)
    guided = one.guide.candidates.counts() > 0
    assert bool(guided.any()) and not bool(guided[:80].any() and guided[-80:].any())
    for threads in (2, 5, 30):
        assert_same_bits(one, picture(threads))


def test_the_same_seed_gives_the_same_bits_and_another_seed_others():
    one, again, other = rendered("lis-o"), rendered("lis-o"), rendered("lis-o", seed=1)
    assert_same_bits(one, again)
    assert not torch.equal(one.film.radiance(), other.film.radiance())


@pytest.mark.parametrize("mode", ["uniform", "lis", "lis-b", "lis-o"])
def test_the_first_step_is_uniform(mode):
    loop = RenderLoop(scene(), RenderSettings(mode, threads=1))
    uniform = RenderLoop(scene(), RenderSettings("uniform", threads=1))
    stats = loop.step()
    uniform.step()
    assert math.isnan(stats.outside) and math.isnan(stats.beta) and math.isnan(stats.kl)
    assert torch.equal(loop.film.radiance(), uniform.film.radiance())


class Diary:
    """What the guide is like after each step."""

    def __init__(self, mode: str, steps: int):
        loop = RenderLoop(scene(), RenderSettings(mode, threads=1))
        self.fits: list[int] = []
        refit = loop.guide.refit

        def noted_refit(mean_luminance: float) -> None:
            self.fits.append(loop.step_number)
            refit(mean_luminance)

        loop.guide.refit = noted_refit
        self.logits, self.means, self.coefficients, self.stats = [], [], [], []
        for _ in range(steps):
            self.stats.append(loop.step())
            self.logits.append(loop.guide.blend.logit.detach().clone())
            self.means.append(loop.guide.field.mean.clone())
            offsets = loop.guide.offsets
            self.coefficients.append(None if offsets is None else offsets.coefficients.detach().clone())


@pytest.mark.parametrize("mode", ["lis", "lis-b"])
def test_the_field_is_fitted_after_every_step(mode):
    diary = Diary(mode, FITS + 3)
    assert diary.fits == list(range(1, FITS + 4))
    assert diary.coefficients[-1] is None
    assert not math.isnan(diary.stats[1].outside)


def test_lis_keeps_its_blend_weight():
    diary = Diary("lis", 4)
    assert all(torch.equal(logit, diary.logits[0]) for logit in diary.logits)
    assert diary.stats[-1].beta == pytest.approx(0.8, abs=1e-5)


def test_the_blend_weight_learns_from_the_second_step():
    diary = Diary("lis-b", 3)
    assert len(diary.logits[0].unique()) == 1
    assert len(diary.logits[1].unique()) > 1
    moved = (diary.logits[1] - diary.logits[0]).abs()
    assert float(moved.max()) == pytest.approx(0.1, rel=1e-3)  # Adam's first step is the learning rate


def test_lis_o_fits_eight_times_then_lets_the_offsets_learn():
    diary = Diary("lis-o", FITS + 3)
    assert diary.fits == list(range(1, FITS + 1))
    assert all(torch.equal(mean, diary.means[FITS - 1]) for mean in diary.means[FITS - 1 :])
    assert not torch.equal(diary.means[FITS - 2], diary.means[FITS - 1])
    assert diary.coefficients[: FITS - 1] == [None] * (FITS - 1)
    assert not diary.coefficients[FITS - 1].any()  # frozen after step 8, at zero during step 9
    assert float(diary.coefficients[FITS].abs().max()) == pytest.approx(0.01, rel=1e-3)
    assert not torch.equal(diary.coefficients[FITS], diary.coefficients[FITS + 1])


def test_what_is_learnt_stays_finite():
    loop = rendered("lis-o")
    assert all(value.isfinite().all() for value in loop.guide.state_dict().values())
    beta = loop.guide.blend()
    assert 0.05 <= float(beta.detach().min()) and float(beta.detach().max()) <= 0.95


def test_a_pinhole_is_not_guided():
    pinhole = replace(scene(), camera=replace(scene().camera, aperture_radius=0.0))
    loop = RenderLoop(pinhole, RenderSettings("lis-o", threads=1))
    loop.step()
    assert loop.guide is None and loop.guide_images() == {}
    assert float(loop.film.radiance().mean()) > 0.05


def test_guide_images_are_pictures():
    images = rendered("lis-o").guide_images()
    assert images.keys() == {"beta", "record", "spotlights"}
    for name, image in images.items():
        assert image.shape[2] == 3 and float(image.min()) >= 0.0 and float(image.max()) <= 1.0, name
        assert float(image.max()) > 0.0, name


@pytest.mark.parametrize("settings", [{"mode": "fast"}, {"spp": 0}, {"threads": 0}])
def test_settings_name_what_is_out_of_range(settings):
    (field,) = settings
    with pytest.raises(BokehguideError, match=f"^{field}: .*; (choose|give)"):
        RenderSettings(**settings)


def test_a_bad_sample_does_not_spoil_what_its_pixel_learns():
    """NaN radiance is kept off the film and out of β and the record buffer."""
    loop = RenderLoop(scenes.lamps(32, 18), RenderSettings("lis-b", seed=3, threads=1))
    trace = loop.tracer.trace

    def spoilt(*args, **keywords):
        samples = trace(*args, **keywords)
        samples.radiance[:, ::3] = torch.nan
        return samples

    loop.step()
    loop.tracer.trace = spoilt
    loop.step()
    loop.tracer.trace = trace
    assert loop.film.bad_count > 0
    assert bool(loop.guide.blend.logit.isfinite().all()) and bool(loop.guide.record.sums.isfinite().all())
    bad = loop.film.bad_count
    loop.step()
    assert loop.film.bad_count == bad and bool(loop.film.radiance().isfinite().all())
