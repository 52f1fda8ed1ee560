"""The error of a render so far, and its end, for the progress bar."""

from __future__ import annotations

import math
import time

from bokehguide.train import AdaptiveLoop, RenderLoop, StepStats

INTERVAL, SHARE = 2.0, 50.0
"""Seconds from one estimate of the error to the next: at least so many, and so many times the time of an estimate."""
FADING = 0.7
"""Weight of the earlier steps in the mean time of a step, for each new step."""


class Forecast:
    """The estimated error of a render, and the time left until the first of its limits ends it.

    end: the time of `time.monotonic` at which --time-limit ends the render, inf without it.
    """

    def __init__(self, loop: RenderLoop | AdaptiveLoop, end: float = math.inf):
        self._loop, self._end = loop, end
        self._pace = 0.0
        self._due = 0.0
        self._error: tuple[float, int] | None = None
        """The last estimate, and its step."""

    def add(self, stats: StepStats) -> None:
        """Count one step; estimates the error now and then, as estimates take time. Collective."""
        self._pace = FADING * self._pace + (1.0 - FADING) * stats.seconds if self._pace else stats.seconds
        alone, step = self._loop.ranks.alone, stats.step
        # Several ranks merge their films for an estimate, at steps on which all of them agree.
        if step > 1 and (time.monotonic() >= self._due if alone else step & (step - 1) == 0):
            start = time.monotonic()
            self._error = self._loop.picture().relative_noise(), step
            now = time.monotonic()
            self._due = now + max(INTERVAL, SHARE * (now - start))

    @property
    def steps_left(self) -> float:
        """Steps until the first limit ends the render: SPP, the time, or the target noise."""
        loop = self._loop
        left = float(loop.settings.spp - loop.step_number)
        if self._pace > 0.0:
            left = min(left, (self._end - time.monotonic()) / self._pace)
        if isinstance(loop, AdaptiveLoop) and loop.expected_steps is not None:
            left = min(left, loop.expected_steps - loop.step_number)
        return max(left, 0.0)

    @property
    def seconds_left(self) -> float:
        """Seconds until the first limit ends the render."""
        return self.steps_left * self._pace

    def words(self) -> list[str]:
        """The error in words; with a target noise also the share of finished blocks, and the error at the end after an arrow."""
        loop, adaptive, words = self._loop, isinstance(self._loop, AdaptiveLoop), []
        if isinstance(loop, AdaptiveLoop):
            words.append(f"blocks {100.0 * loop.finished_share:.0f} %")
        if self._error is not None:
            error, step = self._error
            end = error * math.sqrt(step / (loop.step_number + self.steps_left))
            words.append(f"error {error:.3f}" + (f" -> {end:.3f}" if adaptive else ""))
        return words
