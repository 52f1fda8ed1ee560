"""Handling of Ctrl-C and SIGTERM during a render, so that the render can finish the step and write the picture."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self

from bokehguide.stopping import NUMBERS, leave_signals_to_handlers

ONE_REQUEST = 1.0
"""Seconds within which signals of a kind are one request. `timeout` sends a signal to the process and then to its group."""


class Interrupt:
    """A context in which the first SIGINT and the first SIGTERM only set `signal`. A second signal of a kind has its usual
    effect, unless it arrives within `saving` or within ONE_REQUEST seconds of the first.

    torchrun sends SIGTERM after the SIGINT of a Ctrl-C. Both signals are one request. tell: called once, by the handler of the
    first signal.
    """

    def __init__(self, tell: Callable[[], object] | None = None) -> None:
        self.signal: int | None = None
        self._tell = tell
        self._received: dict[int, float] = {}
        """Times of the first signals, by number."""
        self._saving = False

    @property
    def requested(self) -> bool:
        """Whether a signal has arrived."""
        return self.signal is not None

    @contextmanager
    def saving(self) -> Iterator[None]:
        """A context in which a second signal has no effect, so that files are written whole."""
        self._saving = True
        try:
            yield
        finally:
            self._saving = False

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
        since = time.monotonic() - self._received.setdefault(number, time.monotonic())
        if since > ONE_REQUEST and not self._saving:
            signal.signal(number, self._previous[signal.Signals(number)])
            signal.raise_signal(number)
            return
        first, self.signal = self.signal is None, self.signal or number
        if first and self._tell is not None:
            self._tell()
