"""The registry of modes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bokehguide import BokehguideError, RenderLoop, RenderSettings
from bokehguide.guiding import register_mode
from bokehguide.guiding.builders import uniform
from bokehguide.guiding.config import GaussianConfig, GuidedConfig, HighlightConfig
from bokehguide.guiding.modes import MODES, ModeEntry
from bokehguide.guiding.protocols import LensPoints, LensQuery, LensSampler, LightStrategy, Mode, SampleReuse
from bokehguide.runtime.timer import PhaseTimer
from tests.support import scenes


@pytest.fixture(autouse=True)
def registry():
    """The modes, as they were before the test at its end."""
    before = dict(MODES)
    yield MODES
    MODES.clear()
    MODES.update(before)


def own(context):
    return uniform(context)


def test_a_registered_mode_renders():
    register_mode("own", own)
    with RenderLoop(scenes.emitters(16, 10), RenderSettings("own", 1, threads=1)) as loop:
        loop.step()
        assert loop.film.layers()["beauty"].max() > 0.0


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("guided", "'guided' is the mode of bokehguide.guiding.builders:guided; choose another"),
        ("reference", "'reference' is another picture of `bokehguide compare`; choose another"),
        *((name, "is no name of at most 64 letters") for name in ("", "a,b", "../a", "-a", "a b", "ä", "a" * 65, None)),
    ],
)
def test_a_name_that_cannot_be_used_is_refused(name, told):
    before = dict(MODES)
    with pytest.raises(BokehguideError, match="register_mode: name") as error:
        register_mode(name, own)
    assert told in str(error.value)
    assert before == MODES


def test_a_name_of_another_function_is_taken_and_a_cell_that_runs_again_replaces_its_mode():
    def again():
        def builder(context):
            return uniform(context)

        return builder

    register_mode("own", own)
    with pytest.raises(BokehguideError, match=r"'own' is the mode of .*test_guiding_modes:own"):
        register_mode("own", again())
    register_mode("cell", again())
    register_mode("cell", second := again())
    assert MODES["cell"].builder is second


def test_a_builder_is_a_function():
    with pytest.raises(BokehguideError, match="builder: 'rim:rim' is no function"):
        register_mode("rim", "rim:rim")


def test_a_mode_of_the_whole_frame_refuses_a_crop():
    register_mode("own", own, whole_frame=True)
    with pytest.raises(BokehguideError, match="crop: own reuses samples of the whole frame"):
        RenderSettings("own", crop=(0, 0, 4, 4))


class Bare(LensSampler):
    """A lens sampler without `query`."""


class Unfinished(LensSampler):
    """A lens sampler whose query lacks `sample` and `pdf`."""

    def query(self, batch):
        return LensQuery()


@pytest.mark.parametrize(
    ("sampler", "told"),
    [
        (Bare, "Bare: the method query(batch) is missing; define it, to return a LensQuery"),
        (Unfinished, "LensQuery: the method sample() is missing; define it, to return LensPoints"),
    ],
)
def test_a_missing_method_is_told_in_a_line(sampler, told):
    register_mode("own", lambda context: Mode(sampler(context), LightStrategy(context)))
    with (
        RenderLoop(scenes.emitters(16, 10), RenderSettings("own", 1, threads=1)) as loop,
        pytest.raises(BokehguideError) as error,
    ):
        loop.step()
    assert str(error.value) == told


class Drawn(LensQuery):
    """Lens points in the centre of the lens, after a change of the points and the weights."""

    def __init__(self, count, change):
        self.count, self.change = count, change

    def sample(self):
        return self.change(torch.zeros(2, self.count), torch.ones(self.count))


def drawing(change):
    """A builder of a mode with the lens points of `Drawn`."""

    class Sampler(LensSampler):
        def query(self, batch):
            return Drawn(batch.focus.shape[1], change)

    return lambda context: Mode(Sampler(context), LightStrategy(context))


def step_error(builder):
    """The message of the error that the first step of a mode raises."""
    register_mode("own", builder)
    with (
        RenderLoop(scenes.emitters(16, 10), RenderSettings("own", 1, threads=1)) as loop,
        pytest.raises(BokehguideError) as error,
    ):
        loop.step()
    return str(error.value)


POINTS, WEIGHT = ("; return float32 [2, 160] for 160 pixels", "; return float32 [160] for 160 pixels")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda points, weight: LensPoints(points.T, weight), "points: float32 [160, 2]" + POINTS),
        (lambda points, weight: LensPoints(points.double(), weight), "points: float64 [2, 160]" + POINTS),
        (lambda points, weight: LensPoints(points.to("meta"), weight), "points: float32 [2, 160] on meta" + POINTS),
        (lambda points, weight: LensPoints(None, weight), "points: a NoneType" + POINTS),
        (lambda points, weight: LensPoints(points, weight[None]), "weight: float32 [1, 160]" + WEIGHT),
        (lambda points, weight: LensPoints(points, weight > 0.0), "weight: bool [160]" + WEIGHT),
        (lambda points, weight: LensPoints(points, weight.numpy()), "weight: a ndarray" + WEIGHT),
        (lambda points, weight: (points, weight), "a tuple; return LensPoints(points, weight)"),
        (lambda points, weight: None, "a NoneType; return LensPoints(points, weight)"),
    ],
)
def test_lens_points_that_do_not_fit_are_told_in_a_line(change, told):
    assert step_error(drawing(change)) == f"mode: own: Drawn.sample() returned {told}"


def test_a_lens_query_of_another_class_is_told_in_a_line():
    class Forgetful(LensSampler):
        def query(self, batch):
            pass

    told = step_error(lambda context: Mode(Forgetful(context), LightStrategy(context)))
    assert told == "mode: own: query(batch) returned a NoneType; return a LensQuery"


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("name", ["points", "weight"])
def test_samples_with_a_lens_point_or_a_weight_that_is_not_finite_are_left_out(name, bad):
    def spoilt(points, weight):
        {"points": points[1], "weight": weight}[name][::2] = bad
        return LensPoints(points, weight)

    register_mode("own", drawing(spoilt))
    with RenderLoop(replace(scenes.emitters(16, 10), environment=None), RenderSettings("own", 1, threads=1)) as loop:
        loop.step()
        assert loop.film.bad_count == 80 and loop.film.radiance().isfinite().all()


@pytest.mark.parametrize(
    ("call", "missing"),
    [
        (
            lambda: LensQuery().pdf(torch.zeros(2, 3)),
            "LensQuery: the method pdf(points) is missing; define it, to return densities",
        ),
        (
            lambda: SampleReuse().resample(slice(0, 4), 1, PhaseTimer()),
            "SampleReuse: the method resample(span, step, timer) is missing; define it, to return FilmSamples and a ray count",
        ),
    ],
)
def test_a_missing_density_or_second_pass_is_told_in_a_line(call, missing):
    with pytest.raises(BokehguideError) as error:
        call()
    assert str(error.value) == missing


def uniform_of_two(scene, camera):
    return uniform(scene)


@pytest.mark.parametrize(
    ("builder", "told"),
    [
        ("nowhere_at_all:mode", "nowhere_at_all:mode cannot be imported (ModuleNotFoundError: No module named 'nowhere_at_all')"),
        ("bokehguide.errors:mode", "has no attribute 'mode'); repair its module"),
        ("bokehguide.errors", "bokehguide.errors is no function; name it as module:function"),
        (lambda context: None, "returned a NoneType; return a Mode"),
        (lambda: None, "<lambda>() does not take one ModeContext; define it as <lambda>(context)"),
        (uniform_of_two, "uniform_of_two(scene, camera) does not take one ModeContext; define it as uniform_of_two(context)"),
    ],
)
def test_a_builder_that_fails_is_told_in_a_line(builder, told, registry):
    registry["own"] = ModeEntry(builder)
    with pytest.raises(BokehguideError) as error:
        RenderLoop(scenes.emitters(16, 10), RenderSettings("own", 1, threads=1))
    assert told in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["reuse_group", "denoised_reuse_group"])
@pytest.mark.parametrize("size", [0, 3, 12, 128, 1.5, None])
def test_a_group_of_another_size_is_refused(name, size):
    """The native core has no tables for larger groups, and the numbers of members are bits."""
    with pytest.raises(BokehguideError, match=f"GuidedConfig.{name}: {size} is out of range; give a power of two from 1 to 64"):
        GuidedConfig(**{name: size})


@pytest.mark.parametrize(
    ("config", "name", "value", "told"),
    [
        (GuidedConfig, "split_count", 0, "0 is out of range; give a whole number from 1 to 64"),
        (GuidedConfig, "light_candidates", 2.0, "2.0 is out of range"),
        (GuidedConfig, "blend_pool", 4, "4 is even"),
        (GuidedConfig, "first_blend", 1.5, "1.5 is out of range"),
        (GuidedConfig, "min_blend", 0.95, "0.95 is above max_blend, 0.9"),
        (GuidedConfig, "emitter_scale", "1", "'1' is not a number"),
        (GuidedConfig, "learn_lights", 1, "1 is neither true nor false"),
        (GuidedConfig, "highlights", None, "None is no HighlightConfig"),
        (GaussianConfig, "blend", 1.0, "1.0 is out of range"),
        (GaussianConfig, "offset_degree", -1, "-1 is out of range"),
        (GaussianConfig, "fits", 0, "0 is out of range"),
        (GaussianConfig, "sigma_scale", float("nan"), "nan is"),
        (HighlightConfig, "depth_gap", -1.0, "-1.0 is out of range"),
    ],
)
def test_settings_out_of_range_are_refused(config, name, value, told):
    with pytest.raises(BokehguideError, match=f"{config.__name__}.{name}: {told}"):
        config(**{name: value})
