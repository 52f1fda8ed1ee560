"""Renders that several ranks resume from a state of one: the picture and all learned state are those of a single rank."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch

from bokehguide.runtime.distributed import Ranks
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.sharing_cases import spoil, terrace
from tests.support.thread_ranks import job

SAVED, LAST = 3, 9
"""Steps at which the state is saved and compared; epochs end with steps 4 and 8."""


def compared(loop: RenderLoop) -> tuple[dict[str, torch.Tensor], tuple]:
    """The layers of the picture and the learned state; and the bad samples."""
    picture, state = loop.picture(), loop.state_dict()
    found = {name: torch.from_numpy(layer) for name, layer in picture.layers().items()}
    for part in ("lens", "lights", "reuse"):
        found |= {f"{part} {name}": value for name, value in state[part].items()}
    return found, (picture.bad_count, picture.bad_samples)


def finished(loop: RenderLoop) -> tuple[dict[str, torch.Tensor], tuple]:
    while loop.step_number < LAST:
        loop.step()
    return compared(loop)


@pytest.mark.parametrize("mode, crop", [("guided", None), ("guided", (3, 2, 20, 19)), ("lis-b", (3, 2, 20, 19))])
def test_ranks_resume_a_render_of_one_rank(mode, crop):
    scene, settings = terrace(24, 24, sheet=True), RenderSettings(mode, seed=4, threads=1, crop=crop)
    whole = RenderLoop(scene, settings)
    spoil(whole)
    while whole.step_number < SAVED:
        whole.step()
    state = deepcopy(whole.state_dict())
    expected, bad = finished(whole)
    assert bad[0] > 20

    def resumed(ranks: Ranks) -> tuple[dict[str, torch.Tensor], tuple]:
        loop = RenderLoop(scene, settings, ranks)
        loop.load_state_dict(deepcopy(state))
        return finished(loop)

    for found, its_bad in job(2, resumed):
        assert its_bad == bad
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-5, msg=lambda text, name=name: f"{name}: {text}")
