"""Handling of Ctrl-C and SIGTERM during a render, so that the render can finish the step and write the picture."""

from __future__ import annotations

import signal
import time
from typing import Self

from bokehguide.stopping import NUMBERS, leave_signals_to_handlers


class Interrupt:
    """A context in which the first SIGINT and the first SIGTERM only set `signal`. A second signal of a kind has its usual
    effect.

    torchrun sends SIGTERM after the SIGINT of a Ctrl-C. Both signals are one request.
    """

    def __init__(self) -> None:
        self.signal: int | None = None

    @property
    def requested(self) -> bool:
        """Whether a signal has arrived."""
        return self.signal is not None

    def wait(self) -> None:
        """Wait for a signal."""
        while not self.requested:
            time.sleep(0.2)  # a handler runs between two of these; `signal.pause` misses one that comes just before

    def __enter__(self) -> Self:
        leave_signals_to_handlers()
        self._previous = {number: signal.signal(number, self._request) for number in NUMBERS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _request(self, number: int, _: object) -> None:
        self.signal = self.signal or number
        signal.signal(number, self._previous[signal.Signals(number)])
