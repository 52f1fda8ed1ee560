"""State dicts of loops: a state that is not of one moment, or not of the loop, is refused, and changes nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GaussianConfig
from bokehguide.train import MODES, AdaptiveLoop, RenderLoop, RenderSettings, make_loop
from bokehguide.train.adaptive import FIRST_ROUND
from tests.support import scenes
from tests.support.sharing_cases import spoil

KINDS = {"plain": {}, "split": {"denoise": True}, "adaptive": {"target_noise": 1e-3}}


def loop_of(mode: str = "guided", **others) -> RenderLoop | AdaptiveLoop:
    return make_loop(scenes.emitters(48, 27), RenderSettings(mode, threads=1, reuse_radius=3.0, **others))


def onwards(loop: Any, steps: int) -> Any:
    for _ in range(steps):
        loop.step()
    return loop


def assert_equal(one: object, other: object, name: str = "") -> None:
    """Two states have the same bits."""
    if isinstance(one, dict | list | tuple):
        assert isinstance(other, dict | list | tuple) and len(one) == len(other), name
        for key in one if isinstance(one, dict) else range(len(one)):
            assert_equal(one[key], other[key], f"{name}/{key}")
    elif isinstance(one, torch.Tensor):
        assert isinstance(other, torch.Tensor) and torch.equal(one, other), name
    else:
        assert one == other, name


def assert_refused(loop: Any, state: Any, words: str) -> None:
    """`loop` refuses the state in one line, and goes on as if nothing had happened."""
    before = deepcopy(loop.state_dict())
    with pytest.raises(BokehguideError, match=rf"^(Render|Adaptive)Loop\.load_state_dict: .*{words}") as refusal:
        loop.load_state_dict(state)
    assert len(str(refusal.value).splitlines()) == 1
    assert_equal(before, loop.state_dict())


@pytest.mark.parametrize("mode", MODES)
def test_a_state_that_went_on_is_refused(mode):
    first, second = onwards(loop_of(mode), 2), onwards(loop_of(mode), 1)
    live, kept = first.state_dict(), deepcopy(first.state_dict())
    onwards(first, 2)
    assert_refused(second, live, r"the state is of step 2, and its film has the samples of 4 steps\. A loop shares")
    second.load_state_dict(kept)
    assert second.step_number == 2 and float(second.film.counts().max()) == 2.0
    assert_equal(first.film.state_dict(), onwards(second, 2).film.state_dict())


@pytest.mark.parametrize("kind", ["split", "adaptive"])
@pytest.mark.parametrize("steps", [1, 2, 2 * FIRST_ROUND])
def test_so_is_that_of_a_film_with_halves(kind, steps):
    first, second = onwards(loop_of(**KINDS[kind]), steps), loop_of(**KINDS[kind])
    live, kept = first.state_dict(), deepcopy(first.state_dict())
    onwards(first, 1)
    assert_refused(second, live, "and its film has the samples of")
    second.load_state_dict(kept)
    assert second.step_number == steps
    assert_equal(first.picture().layers()["beauty"].tolist(), onwards(second, 1).picture().layers()["beauty"].tolist())


@pytest.mark.parametrize("ended", [[True, False], [True, True]])
def test_blocks_that_ended_have_fewer_samples(ended):
    """The first block has ended in the first half, and perhaps in the other as well; the second block goes on."""
    first, second = onwards(loop_of(**KINDS["adaptive"]), 4), loop_of(**KINDS["adaptive"])
    first.open[:, 0] = ~torch.tensor(ended)
    first._render_open_blocks()
    onwards(first, 4)
    counts = [half.film.counts() for half in first.halves]
    assert [float(count.min()) for count in counts] == [2.0 if end else 4.0 for end in ended]
    second.load_state_dict(deepcopy(first.state_dict()))
    assert_equal(first.state_dict(), second.state_dict())
    live = first.state_dict()
    onwards(first, 1)
    assert_refused(second, live, "and its film has the samples of 5 steps")


@pytest.mark.parametrize("kind", ["plain", "split"])
def test_bad_samples_are_missing_on_the_film(kind):
    first, second = loop_of(**KINDS[kind], seed=-5), loop_of(**KINDS[kind], seed=-5)
    for loop in (first, second):
        onwards(loop, 1)
        spoil(loop)
    second.load_state_dict(deepcopy(first.state_dict()))
    assert second.film.bad_samples == first.film.bad_samples and first.film.bad_samples
    live = first.state_dict()
    spoil(first)
    assert_refused(second, live, "the state is of step 2, and its film has the samples of 3 steps")


def without(*names: str) -> Callable[[dict], dict]:
    """A function that removes the part of the last name."""

    def removed(state: dict) -> dict:
        part = state
        for name in names[:-1]:
            part = part[name]
        del part[names[-1]]
        return state

    return removed


def with_value(*names: Any, value: Any) -> Callable[[dict], dict]:
    """A function that replaces the part of the last name."""

    def replaced(state: dict) -> dict:
        part = state
        for name in names[:-1]:
            part = part[name]
        part[names[-1]] = value
        return state

    return replaced


WRONG = {
    "empty": (lambda _: {}, "step is missing; give the state_dict"),
    "a number": (lambda _: 3, "int is no state; give the state_dict"),
    "without a film": (without("film"), "film is missing"),
    "without a layer": (without("film", "square"), "film: square is missing"),
    "with more": (with_value("more", value=1), "more is no part of this loop"),
    "a step of text": (with_value("step", value="2"), "step: '2' is no number"),
    "another step": (with_value("step", value=3), "the state is of step 3, and its film has the samples of 2 steps"),
    "another size": (with_value("film", "count", value=torch.ones(5)), r"count has the shape \(5,\), not \(1296,\)"),
    "NaN": (
        with_value("film", "radiance", value=torch.full((3, 1296), math.nan, dtype=torch.float64)),
        "film: radiance: a tensor .* that is not finite",
    ),
    "short bad samples": (with_value("film", "bad_samples", value=[(1, 2, 3)]), "expected 4"),
    "another lens": (with_value("lens", "outlines", value=torch.zeros(12, 99)), "the learned state does not fit"),
    "a later epoch": (with_value("lights", "sampler.epoch", value=torch.tensor(9)), "the learned state does not fit"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_state_changes_nothing(name):
    change, words = WRONG[name]
    state = change(deepcopy(onwards(loop_of(), 2).state_dict()))
    assert_refused(onwards(loop_of(seed=1), 4), state, words)


def test_a_wrong_half_changes_neither():
    right = deepcopy(onwards(loop_of(target_noise=0.5), 4).state_dict())
    loop = onwards(loop_of(target_noise=0.5, seed=1), 3)
    epoch = with_value("halves", 1, "lights", "sampler.epoch", value=torch.tensor(9))
    for change, words in (
        (epoch, "the learned state does not fit"),
        (with_value("halves", value=right["halves"][:1]), "halves is no list of two states"),
        (with_value("open", value=right["open"][:1]), "the blocks or the steps are those of another render"),
        (with_value("brightness", value=right["brightness"][:1]), "the blocks or the steps are those of another render"),
        (with_value("step", value=7), "the blocks or the steps are those of another render"),
        (lambda _: None, "NoneType is no state"),
    ):
        assert_refused(loop, change(deepcopy(right)), words)
    loop.load_state_dict(right)


@pytest.mark.parametrize("mode", MODES)
def test_the_state_of_another_mode_is_refused(mode):
    """`area-restir` has the parts of `uniform`, but a film with a control variate."""
    state = deepcopy(onwards(loop_of("lis-b" if mode == "uniform" else "uniform"), 2).state_dict())
    assert_refused(onwards(loop_of(mode), 1), state, "give the state_dict\\(\\) of a loop with the same scene and settings")


@pytest.mark.parametrize(("mode", "kind"), [*((mode, "plain") for mode in MODES), ("uniform", "split"), ("uniform", "adaptive")])
def test_the_state_of_a_film_of_another_shape_is_refused(mode, kind):
    """Of as many pixels: uniform sampling learns nothing that tells the shapes apart."""
    settings = RenderSettings(mode, threads=1, reuse_radius=3.0, **KINDS[kind])
    with make_loop(scenes.emitters(36, 64), settings) as upright, make_loop(scenes.emitters(64, 36), settings) as lying:
        assert_refused(lying, onwards(upright, 2).state_dict(), "the film has 36x64 pixels, not 64x36; give the state_dict")


def test_offsets_come_back_after_a_wrong_state():
    """A state from before the offsets drops them; the loop goes on like one that never saw this state."""
    early = deepcopy(onwards(loop_of("lis-o"), 3).state_dict())
    one, other = (onwards(loop_of("lis-o"), GaussianConfig.fits + 2) for _ in range(2))
    for change in (without("optimizers", "blend"), with_value("lens", "epoch", value=torch.tensor(99))):
        assert_refused(one, change(deepcopy(early)), "the learned state does not fit")
    for loop in (one, other):
        onwards(loop, 3)
    phases = {"phases": {}}
    assert one.mode.lens.offsets is not None
    assert_equal(one.state_dict() | phases, other.state_dict() | phases)
