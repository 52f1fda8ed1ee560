"""The registry of modes."""

from __future__ import annotations

import pytest
import torch

from bokehguide import BokehguideError, RenderLoop, RenderSettings
from bokehguide.guiding import register_mode
from bokehguide.guiding.builders import uniform
from bokehguide.guiding.modes import MODES, ModeEntry
from bokehguide.guiding.protocols import LensQuery, LensSampler, LightStrategy, Mode
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


def test_a_missing_density_is_told_in_a_line():
    with pytest.raises(BokehguideError, match=r"^LensQuery: the method pdf\(points\) is missing; define it, to return densities"):
        LensQuery().pdf(torch.zeros(2, 3))


@pytest.mark.parametrize(
    ("builder", "told"),
    [
        ("nowhere_at_all:mode", "nowhere_at_all:mode cannot be imported (ModuleNotFoundError: No module named 'nowhere_at_all')"),
        ("bokehguide.errors:mode", "has no attribute 'mode'); repair its module"),
        ("bokehguide.errors", "bokehguide.errors is no function; name it as module:function"),
        (lambda context: None, "returned a NoneType; return a Mode"),
    ],
)
def test_a_builder_that_fails_is_told_in_a_line(builder, told, registry):
    registry["own"] = ModeEntry(builder)
    with pytest.raises(BokehguideError) as error:
        RenderLoop(scenes.emitters(16, 10), RenderSettings("own", 1, threads=1))
    assert told in str(error.value)
    assert "\n" not in str(error.value)
