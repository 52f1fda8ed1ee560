"""Worker threads whose work can be abandoned in the middle of a step."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from copy import copy
from typing import TypeVar

import torch

from bokehguide.runtime.workers import Workers

Item = TypeVar("Item")
Result = TypeVar("Result")


class AbandonedError(Exception):
    """The step was abandoned. Its loop holds a part of the step and must take no further step."""


class StoppableWorkers(Workers):
    """As `Workers`. While `stop` is set, `map` begins no further item and raises AbandonedError."""

    def __init__(self, threads: int):
        super().__init__(threads, torch.device("cpu"))
        self.stop = threading.Event()

    def renewed(self) -> StoppableWorkers:
        """The same threads with a `stop` of their own."""
        other = copy(self)
        other.stop = threading.Event()
        return other

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """As `Workers.map`."""

        def run(item: Item) -> Result:
            if self.stop.is_set():
                raise AbandonedError
            return work(item)

        return super().map(run, items)
