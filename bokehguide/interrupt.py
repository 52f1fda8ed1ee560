"""Ctrl-C or SIGTERM during a render: finish the step, then write what is there."""

from __future__ import annotations

import signal


class Interrupt:
    """A context in which the first SIGINT or SIGTERM only sets `signal`; a second one of its kind acts as usual.

    torchrun sends a SIGTERM after the SIGINT of a Ctrl-C: both together are one request.
    """

    def __init__(self) -> None:
        self.signal: int | None = None

    @property
    def requested(self) -> bool:
        return self.signal is not None

    def __enter__(self) -> Interrupt:
        self._previous = {number: signal.signal(number, self._request) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _request(self, number: int, _: object) -> None:
        self.signal = self.signal or number
        signal.signal(number, self._previous[number])
