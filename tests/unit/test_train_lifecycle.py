"""Loops end the threads that they start, and leave the process as they found it."""

from __future__ import annotations

import copy
import pickle
import threading

import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.train import RenderSettings
from bokehguide.train.adaptive import AdaptiveLoop, make_loop
from bokehguide.train.loop import RenderLoop
from tests.support import scenes

KINDS = pytest.mark.parametrize("kind, target_noise", [(RenderLoop, None), (AdaptiveLoop, 0.5)])


def loop_of(target_noise: float | None) -> RenderLoop | AdaptiveLoop:
    return make_loop(scenes.emitters(32, 18), RenderSettings(threads=2, target_noise=target_noise))


@pytest.fixture
def started_threads():
    """A function that returns the running threads that the test has started."""
    before = set(threading.enumerate())
    return lambda: set(threading.enumerate()) - before


@KINDS
def test_a_context_ends_the_threads_of_a_loop(kind, target_noise, started_threads):
    openmp_threads = torch.get_num_threads()
    with loop_of(target_noise) as loop:
        assert isinstance(loop, kind) and not started_threads()
        for _ in range(2):
            loop.step()
        assert 1 <= len(started_threads()) <= 2
    assert not started_threads()
    assert torch.get_num_threads() == openmp_threads


@KINDS
def test_an_error_in_a_context_ends_the_threads(kind, target_noise, started_threads):
    with pytest.raises(ZeroDivisionError), loop_of(target_noise) as loop:
        loop.step()
        raise ZeroDivisionError
    assert not started_threads()


@KINDS
def test_a_closed_loop_keeps_its_picture_and_takes_no_step(kind, target_noise, started_threads):
    loop = loop_of(target_noise)
    for _ in range(2):
        loop.step()
    picture = loop.picture().radiance().clone()
    for _ in range(2):  # closing twice is allowed
        loop.close()
    assert not started_threads()
    assert float(picture.max()) > 0.0 and torch.equal(loop.picture().radiance(), picture)
    other = loop_of(target_noise)
    other.load_state_dict(loop.state_dict())
    assert torch.equal(other.picture().radiance(), picture)
    with pytest.raises(BokehguideError, match="the loop is closed; take all steps in its `with` block, or make another loop"):
        loop.step()
    assert loop.step_number == 2 and torch.equal(loop.picture().radiance(), picture)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("daylight", RenderSettings()), "scene: 'daylight' is no Scene; give one, as from bokehguide.load_scene"),
        ((scenes.emitters(32, 18), "guided"), "settings: 'guided' is no RenderSettings"),
    ],
)
def test_a_loop_of_other_things_is_refused(given, words):
    for kind in (RenderLoop, AdaptiveLoop, make_loop):
        with pytest.raises(BokehguideError, match=f"^RenderLoop: {words}"):
            kind(*given)


@KINDS
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_loop_cannot_be_copied(kind, target_noise, copied):
    with pytest.raises(
        BokehguideError, match=f"^{kind.__name__}: a loop cannot be copied or pickled; copy its film, or load its"
    ):
        copied(loop_of(target_noise))


@KINDS
def test_a_loop_without_steps_starts_nothing(kind, target_noise, started_threads):
    with loop_of(target_noise):
        assert not started_threads()
    assert not started_threads()
