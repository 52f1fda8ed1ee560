"""Long renders: what an interruption keeps."""

import signal
from pathlib import Path

import pytest
import torch

from bokehguide.evaluation import long_renders
from bokehguide.evaluation.long_renders import accumulate
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes

SCENE = scenes.emitters(16, 9)
SETTINGS = RenderSettings("uniform", spp=8, seed=5, threads=1)
CHUNK = 4


def interrupted_in_step(number: int, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`accumulate` with a signal within the step `number` of the first chunk."""

    def step(loop: RenderLoop, **options: object) -> object:
        if loop.step_number + 1 == number:
            signal.raise_signal(signal.SIGINT)
        return take_step(loop, **options)

    take_step = RenderLoop.step
    monkeypatch.setattr(RenderLoop, "step", step)
    with pytest.raises(KeyboardInterrupt):
        accumulate(path, SCENE, SETTINGS, CHUNK)
    monkeypatch.setattr(RenderLoop, "step", take_step)


def rendered(seed: int, steps: int) -> torch.Tensor:
    with RenderLoop(SCENE, RenderSettings("uniform", seed=seed, threads=1)) as loop:
        for _ in range(steps):
            loop.step()
        return loop.film.radiance()


def test_an_interruption_keeps_the_steps_of_its_chunk(tmp_path, monkeypatch):
    """The next run goes on from there, with the next seed."""
    path = tmp_path / "half.exr"
    interrupted_in_step(3, path, monkeypatch)
    kept = accumulate(path, SCENE, SETTINGS, CHUNK, deadline=0.0)
    assert (kept.spp, kept.chunks) == (3, 1)
    torch.testing.assert_close(kept.radiance.float(), rendered(5, 3))
    whole = accumulate(path, SCENE, SETTINGS, CHUNK)
    assert (whole.spp, whole.chunks) == (8, 3)
    expected = (3 * rendered(5, 3) + 4 * rendered(6, 4) + rendered(7, 1)) / 8
    torch.testing.assert_close(whole.radiance.float(), expected, rtol=1e-5, atol=1e-6)


def test_one_step_alone_is_not_kept(tmp_path, monkeypatch):
    """One sample has no estimate of the variance."""
    interrupted_in_step(1, tmp_path / "half.exr", monkeypatch)
    assert not (tmp_path / "half.exr").exists()


@pytest.fixture(autouse=True)
def no_bar(monkeypatch):
    monkeypatch.setattr(long_renders, "progress", lambda *given: long_renders.tqdm(disable=True))
