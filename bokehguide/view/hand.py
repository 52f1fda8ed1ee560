"""A thread that works for another one, which need not wait for the end of work that nobody wants any more."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import wait
from typing import TypeVar

import torch

from bokehguide.runtime.workers import Workers
from bokehguide.view.workers import AbandonedError

Answer = TypeVar("Answer")
POLL = 0.004
"""Seconds between two looks at whether work has been abandoned."""


class Hand:
    """Does work one by one, on one thread."""

    def __init__(self) -> None:
        self._thread = Workers(1, torch.device("cpu"))

    def do(self, work: Callable[[], Answer], stop: threading.Event) -> Answer:
        """The result of work. Raises AbandonedError at once where `stop` is set; the work then ends without its caller."""
        future = self._thread.submit(work)
        while not wait([future], POLL).done:
            if stop.is_set():
                raise AbandonedError
        return future.result()

    def rest(self) -> None:
        """Wait for the end of all work."""
        self._thread.submit(lambda: None).result()

    def close(self) -> None:
        """Wait for the work and end the thread."""
        self._thread.close()
