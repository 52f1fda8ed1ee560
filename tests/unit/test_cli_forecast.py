"""The estimated error and the time left in the progress bar."""

import math
import time
from types import SimpleNamespace

import pytest

from bokehguide.cli.forecast import Forecast
from bokehguide.cli.report import Bar
from bokehguide.train import AdaptiveLoop, RenderLoop, RenderSettings
from tests.support.scenes import emitters


def advanced(loop, steps: int, end: float = math.inf) -> Forecast:
    forecast = Forecast(loop, end)
    for _ in range(steps):
        stats = loop.step()
        forecast.add(SimpleNamespace(step=stats.step, seconds=2.0))
    return forecast


def test_the_first_limit_gives_the_time_left():
    with RenderLoop(emitters(32, 20), RenderSettings("uniform", spp=12, threads=1)) as loop:
        assert Forecast(loop).seconds_left == 0.0
        assert advanced(loop, 2).seconds_left == pytest.approx(20.0)
        assert Forecast(loop, time.monotonic() + 7.0).steps_left == 10.0
        assert advanced(loop, 1, time.monotonic() + 7.0).seconds_left == pytest.approx(7.0, abs=0.5)
        assert advanced(loop, 1, time.monotonic() - 7.0).seconds_left == 0.0


def test_the_error_is_that_of_the_picture():
    with RenderLoop(emitters(32, 20), RenderSettings("uniform", spp=12, threads=1)) as loop:
        assert advanced(loop, 1).words() == []
        forecast = advanced(loop, 1)
        assert forecast.words() == [f"error {loop.film.relative_noise():.3f}"]
        told = forecast.words()
        forecast.add(SimpleNamespace(step=3, seconds=2.0))
        assert forecast.words() == told, "estimates take time, and wait for the next interval"


def test_a_target_noise_ends_the_render_and_tells_its_blocks():
    settings = RenderSettings("uniform", spp=4096, threads=1, target_noise=0.02)
    with AdaptiveLoop(emitters(64, 40), settings) as loop:
        forecast = advanced(loop, 31)
        assert forecast.steps_left == 4096 - 31 and loop.expected_steps is None
        forecast = advanced(loop, 1)
        loop.open[:, 0] = False
        blocks, error = forecast.words()
        assert blocks == f"blocks {100 * loop.finished_share:.0f} %" and loop.finished_share >= 0.25
        assert loop.expected_steps >= 32 and forecast.steps_left == min(loop.expected_steps, 4096) - 32
        now, end = map(float, error.removeprefix("error ").split(" -> "))
        assert end == pytest.approx(now * math.sqrt(32 / (32 + forecast.steps_left)), abs=0.001)


def test_the_bar_shows_the_time_left(capsys):
    from bokehguide.cli.report import BAR

    bar = Bar(None, "a", 10, bar_format=BAR)
    bar.seconds_left = 75.0
    bar.update(3)
    bar.refresh()
    bar.close()
    told = capsys.readouterr().err
    assert "<?," in told and "3/10 [00:00<01:15," in told
