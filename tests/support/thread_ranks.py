"""Ranks that are threads of one process: they tell each other what `torchrun`'s processes would."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch
import torch.distributed as dist
from torch import Tensor

from bokehguide.runtime.distributed import Ranks


class _Table:
    """Where the ranks of a job lay down values for each other."""

    def __init__(self, count: int):
        self.values: list = [None] * count
        self.barrier = threading.Barrier(count, timeout=60.0)


class ThreadRanks(Ranks):
    """One of the ranks of a job."""

    def __init__(self, rank: int, count: int, table: _Table):
        super().__init__()
        self.rank, self.count, self._table = rank, count, table

    def gathered(self, value: object) -> list:
        self._table.values[self.rank] = value
        self._table.barrier.wait()
        values = list(self._table.values)
        self._table.barrier.wait()
        return values

    def _reduced(self, values: Tensor, how: dist.ReduceOp) -> Tensor:
        every = torch.stack(self.gathered(values.detach().clone()))
        return every.amax(0) if how == dist.ReduceOp.MAX else every.sum(0, dtype=values.dtype)


def job(count: int, work: Callable[[Ranks], object]) -> list:
    """What `work` returns on each of `count` ranks."""
    if count == 1:
        return [work(Ranks())]
    table = _Table(count)
    with ThreadPoolExecutor(count) as pool:
        started = [pool.submit(work, ThreadRanks(rank, count, table)) for rank in range(count)]
        for each in started:
            if each.exception():
                table.barrier.abort()
        return [each.result() for each in started]
