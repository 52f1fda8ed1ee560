"""The halves of an adaptive render: each is independent of the other, on one rank or on several."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bokehguide.runtime.distributed import Ranks
from bokehguide.train import AdaptiveLoop, RenderSettings, adaptive, load_checkpoint, save_checkpoint
from bokehguide.train.adaptive import HalfLoop
from tests.support import scenes
from tests.support.thread_ranks import job

WIDTH, HEIGHT = 96, 24
"""Three blocks."""
STEPS, ROUNDS = 16, (1, 2, 4, 8, 16)
"""Of each half, and those after which rounds end."""


@pytest.fixture(autouse=True)
def short_rounds(monkeypatch):
    monkeypatch.setattr(adaptive, "FIRST_ROUND", 1)


def never(step: int) -> tuple[int, ...]:
    return ()


def late(step: int) -> tuple[int, ...]:
    return (2,) if step >= 4 else ()


def one_by_one(step: int) -> tuple[int, ...]:
    return tuple(block for block, first in enumerate((2, 8)) if step >= first)


def at_once(step: int) -> tuple[int, ...]:
    return (0, 1, 2)


def decide(half: HalfLoop, done) -> None:
    """Make a half end these blocks of the other half at the ends of rounds."""
    end_round = half.end_round

    def decided() -> torch.Tensor:
        end_round()
        error = torch.ones(HEIGHT, WIDTH, dtype=torch.float64)
        for block in done(half.step_number):
            error[:, adaptive.BLOCK * block : adaptive.BLOCK * (block + 1)] = 0.0
        return error.flatten()

    half.end_round = decided


def learned_by(half: HalfLoop) -> dict[str, torch.Tensor]:
    """The state of all strategies, the mean luminance, and the thresholds of shadow rays."""
    state = half.mode.strategies.items()
    learned = {f"{part} {name}": value for part, strategy in state for name, value in strategy.state_dict().items()}
    learned.pop("reuse control_variate.sums", None)  # a frozen half adds samples to the sums, and does not use them
    return learned | {"mean": torch.tensor(half._mean_luminance), "threshold": half.shadow_roulette.threshold}


def alone(settings: RenderSettings, done) -> tuple[HalfLoop, list[torch.Tensor]]:
    """A half without the other one, which learns until it has ended a block of it; and its film after each round."""
    half, films = HalfLoop(scenes.emitters(WIDTH, HEIGHT), settings, None), []
    for step in range(1, STEPS + 1):
        half.step()
        if step in ROUNDS:
            films.append(half.film.radiance().clone())
            half.end_round()
            if step > 1 and done(step):
                half.freeze()
    return half, films


@pytest.mark.parametrize("other", [never, one_by_one, at_once], ids=lambda done: done.__name__)
@pytest.mark.parametrize("own", [never, late], ids=lambda done: done.__name__)
@pytest.mark.parametrize("mode", ["lis-b", "guided"])
def test_a_half_is_independent_of_the_decisions_of_the_other(mode, own, other):
    """To the bit, in the learned state and in the picture of each block up to its end."""
    settings = RenderSettings(mode, seed=4, threads=1, target_noise=0.1)
    loop = AdaptiveLoop(scenes.emitters(WIDTH, HEIGHT), settings)
    first, second = loop.halves
    decide(first, own)
    decide(second, other)
    for _ in range(2 * STEPS):
        loop.step()
    expected, films = alone(settings, own)
    found = learned_by(first)
    for name, value in learned_by(expected).items():
        assert torch.equal(found[name], value), name
    counts = first.film.layers()["sample_count"]
    steps = {never: (16, 16, 16), one_by_one: (2, 8, 16), at_once: (2, 2, 2)}[other]
    for block, count in enumerate(steps):
        there = (slice(None), slice(adaptive.BLOCK * block, adaptive.BLOCK * (block + 1)))
        assert (counts[there] == count).all()
        assert torch.equal(first.film.radiance()[there], films[ROUNDS.index(count)][there])


def state_of(loop: AdaptiveLoop) -> dict[str, torch.Tensor]:
    """The picture, and the learned state of the halves on all ranks."""
    found = {name: torch.from_numpy(layer) for name, layer in loop.picture().layers().items()}
    for number, half in enumerate(loop.state_dict()["halves"]):
        for part in ("lens", "lights", "reuse"):
            found |= {f"{part} {number} {name}": value for name, value in half.get(part, {}).items()}
    return found


def resumed(checkpoint: Path, settings: RenderSettings, ranks: Ranks) -> dict[str, torch.Tensor]:
    """`state_of` after 40 steps."""
    loop = AdaptiveLoop(scenes.emitters(WIDTH, HEIGHT), settings, ranks)
    load_checkpoint(checkpoint, loop)
    while loop.step_number < 40:
        loop.step()
    return state_of(loop)


@pytest.mark.slow
@pytest.mark.parametrize("mode, target, block", [("uniform", 0.2, 8), ("guided", 0.03, 32), ("guided", 1e-6, 32)])
def test_a_render_goes_on_from_its_checkpoint_on_any_number_of_ranks(mode, target, block, tmp_path, monkeypatch):
    """Blocks end as on one rank; pictures and the learned state agree but for the order of sums."""
    monkeypatch.setattr(adaptive, "BLOCK", block)
    settings = RenderSettings(mode, seed=4, threads=1, target_noise=target)
    whole = AdaptiveLoop(scenes.emitters(WIDTH, HEIGHT), settings)
    for step in range(1, 41):
        whole.step()
        if step == 13:
            save_checkpoint(tmp_path / "a.ckpt", whole, 1.0)
    expected = state_of(whole)
    counts = expected["sample_count"].unique()
    assert counts.tolist() == [40.0] if target == 1e-6 else len(counts) > 1 and counts.max() > 13
    for count in (2, 3):
        for found in job(count, lambda ranks: resumed(tmp_path / "a.ckpt", settings, ranks)):
            assert torch.equal(found["sample_count"], expected["sample_count"])
            for name, value in expected.items():
                torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-5, msg=name)
