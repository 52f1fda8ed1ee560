"""The training loop: what it does when, and that only the seed changes its bits."""

from __future__ import annotations

import math
import weakref
from collections import Counter
from dataclasses import replace

import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GaussianConfig
from bokehguide.guiding.emitter_guide import EmitterGuide
from bokehguide.guiding.guide import GuideRecord
from bokehguide.guiding.protocols import BatchSamples
from bokehguide.guiding.uniform import UniformLens
from bokehguide.render.path_tracer import PathSamples
from bokehguide.scene.types import Scene
from bokehguide.train import LENS_MODES, RenderLoop, RenderSettings
from bokehguide.train.scheduler import Batches
from bokehguide.train.step_stats import BatchResult
from tests.support import scenes
from tests.support.same_bits import assert_same_bits

STEPS = 11


def scene() -> Scene:
    return scenes.emitters(80, 45)


def rendered(mode: str, threads: int = 1, seed: int = 0) -> RenderLoop:
    loop = RenderLoop(scene(), RenderSettings(mode, seed=seed, threads=threads))
    for _ in range(STEPS):
        loop.step()
    return loop


@pytest.mark.parametrize("mode", LENS_MODES)
def test_any_number_of_threads_gives_the_same_bits(mode, monkeypatch):
    """Of a frame cut into several batches."""
    monkeypatch.setattr("bokehguide.train.scheduler.OVERHEAD", 1)
    one = rendered(mode)
    for threads in (2, 3):
        assert_same_bits(one, rendered(mode, threads))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lis-o", "guided"])
def test_so_it_does_where_few_batches_are_guided(mode, monkeypatch):
    """Emitters in some of them, seen through a lens of which 1 / (A / A) is not 1 in single precision."""
    radius = 0.105
    lens = replace(scenes.emitters(80, 45).camera, aperture_radius=radius)
    area = math.pi * torch.tensor(radius) ** 2
    assert float(1.0 / (area * (1.0 / area))) != 1.0
    monkeypatch.setattr("bokehguide.train.scheduler.OVERHEAD", 1)

    def picture(threads: int) -> RenderLoop:
        loop = RenderLoop(replace(scenes.emitters(80, 45), camera=lens), RenderSettings(mode, threads=threads))
        for _ in range(STEPS):
            loop.step()
        return loop

    one = picture(1)
    guided = one.mode.lens.candidates.counts() > 0
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
        refit = loop.mode.lens.refit

        def noted_refit(mean_luminance: float) -> None:
            self.fits.append(loop.step_number)
            refit(mean_luminance)

        loop.mode.lens.refit = noted_refit
        self.logits, self.means, self.coefficients, self.stats = [], [], [], []
        for _ in range(steps):
            self.stats.append(loop.step())
            self.logits.append(loop.mode.lens.blend.logit.detach().clone())
            self.means.append(loop.mode.lens.field.mean.clone())
            offsets = loop.mode.lens.offsets
            self.coefficients.append(None if offsets is None else offsets.coefficients.detach().clone())


@pytest.mark.parametrize("mode", ["lis", "lis-b"])
def test_the_field_is_fitted_after_every_step(mode):
    diary = Diary(mode, GaussianConfig.fits + 3)
    assert diary.fits == list(range(1, GaussianConfig.fits + 4))
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
    diary = Diary("lis-o", GaussianConfig.fits + 3)
    assert diary.fits == list(range(1, GaussianConfig.fits + 1))
    assert all(torch.equal(mean, diary.means[GaussianConfig.fits - 1]) for mean in diary.means[GaussianConfig.fits - 1 :])
    assert not torch.equal(diary.means[GaussianConfig.fits - 2], diary.means[GaussianConfig.fits - 1])
    assert diary.coefficients[: GaussianConfig.fits - 1] == [None] * (GaussianConfig.fits - 1)
    assert not diary.coefficients[GaussianConfig.fits - 1].any()  # frozen after step 8, at zero during step 9
    assert float(diary.coefficients[GaussianConfig.fits].abs().max()) == pytest.approx(0.01, rel=1e-3)
    assert not torch.equal(diary.coefficients[GaussianConfig.fits], diary.coefficients[GaussianConfig.fits + 1])


def test_what_is_learnt_stays_finite():
    loop = rendered("lis-o")
    assert all(value.isfinite().all() for value in loop.mode.lens.state_dict().values())
    beta = loop.mode.lens.blend()
    assert float(beta.detach().min()) >= 0.05 and float(beta.detach().max()) <= 0.95


def test_a_pinhole_is_not_guided():
    pinhole = replace(scene(), camera=replace(scene().camera, aperture_radius=0.0))
    loop = RenderLoop(pinhole, RenderSettings("lis-o", threads=1))
    loop.step()
    assert isinstance(loop.mode.lens, UniformLens) and loop.guide_images() == {}
    assert float(loop.film.radiance().mean()) > 0.05


def test_guide_images_are_pictures():
    images = rendered("lis-o").guide_images()
    assert images.keys() == {"beta", "record", "highlights"}
    for name, image in images.items():
        assert image.shape[2] == 3 and float(image.min()) >= 0.0 and float(image.max()) <= 1.0, name
        assert float(image.max()) > 0.0, name


@pytest.mark.parametrize(
    "settings", [{"mode": "fast"}, {"spp": 0}, {"threads": 0}, {"gaussian": {"blend": 0.5}}, {"guided": "fast"}, {"guided": None}]
)
def test_settings_name_what_is_out_of_range(settings):
    (field,) = settings
    with pytest.raises(BokehguideError, match=f"^{field}: .*; (choose|give)"):
        RenderSettings(**settings)


def test_a_bad_sample_does_not_spoil_what_its_pixel_learns():
    """NaN radiance is kept off the film and out of β and the record buffer."""
    loop = RenderLoop(scenes.emitters(32, 18), RenderSettings("lis-b", seed=3, threads=1))
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
    assert bool(loop.mode.lens.blend.logit.isfinite().all()) and bool(loop.mode.lens.record_buffer.sums.isfinite().all())
    bad = loop.film.bad_count
    loop.step()
    assert loop.film.bad_count == bad and bool(loop.film.radiance().isfinite().all())


@pytest.mark.parametrize("mode", ["lis-b", "guided"])
def test_the_record_has_only_finite_samples_that_pass_the_lens(mode):
    loop = RenderLoop(scenes.emitters(96, 54), RenderSettings(mode, seed=3, threads=1))
    guide, trace = loop.mode.lens, loop.tracer.trace
    record, blocked, bad = guide.record, 0, 0

    def spoiled(*args, **keywords) -> PathSamples:
        samples = trace(*args, **keywords)
        samples.radiance[:, ::3] = torch.nan
        return samples

    def checked(samples: BatchSamples, good: torch.Tensor) -> GuideRecord:
        nonlocal blocked, bad
        report, passes = record(samples, good), samples.drawn.weight > 0.0
        blocked, bad = blocked + int((~passes).sum()), bad + int((~good).sum())
        assert bool((report.records.cells < 0)[~(passes & good)].all()) and bool((report.records.cells >= 0).any())
        return report

    loop.tracer.trace, guide.record = spoiled, checked
    for _ in range(4):
        loop.step()
    assert blocked > 0 and bad > 0


def test_reports_are_freed_before_the_strategies_update(monkeypatch):
    """A large picture has half a gigabyte of reports."""
    reports, alive = [], []
    record, update = EmitterGuide.record, EmitterGuide.update

    def recorded(guide, samples, good):
        found = record(guide, samples, good)
        reports.append(weakref.ref(found.records.cells))
        return found

    def updated(guide, summary):
        alive.append(sum(report() is not None for report in reports))
        update(guide, summary)

    monkeypatch.setattr(EmitterGuide, "record", recorded)
    monkeypatch.setattr(EmitterGuide, "update", updated)
    with RenderLoop(scene(), RenderSettings("guided", threads=1)) as loop:
        stats = [loop.step() for _ in range(2)]
    assert len(reports) > 0 and alive == [0, 0]
    assert 0.0 < stats[1].beta < 1.0


@pytest.mark.parametrize("threads", (1, 3))
def test_strategies_may_work_on_all_threads(threads, monkeypatch):
    found, update = [], EmitterGuide.update

    def updated(guide, summary):
        found.append(summary.threads)
        update(guide, summary)

    monkeypatch.setattr(EmitterGuide, "update", updated)
    with RenderLoop(scene(), RenderSettings("guided", threads=threads)) as loop:
        loop.step()
    assert found == [threads]


def test_the_next_step_is_cut_by_the_seconds_of_the_batches(monkeypatch):
    """The seconds of a batch are the sum over its phases."""
    with RenderLoop(scene(), RenderSettings(mode="uniform", threads=2)) as loop:
        loop.batches = Batches(2, smallest=1)
        render_batch = loop._render_batch

        def timed(places: slice) -> BatchResult:
            result = render_batch(places)
            each = 1.5 if places.start == 0 else 0.5
            result.timer.seconds = Counter({"shading": each, "guiding": each})
            return result

        monkeypatch.setattr(loop, "_render_batch", timed)
        loop.step()
        # 3 s and 1 s: both spans take 2 s if the first ends at a third. NEWEST moves the bound half of the way from the middle.
        pixels = loop.film.width * loop.film.height
        assert loop._spans() == [slice(0, 5 * pixels // 12), slice(5 * pixels // 12, pixels)]
