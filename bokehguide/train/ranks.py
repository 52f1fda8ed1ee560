"""Several processes that render one picture: what they tell each other."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping

import torch
import torch.distributed as dist
from torch import Tensor

from bokehguide.errors import BokehguideError

BAND = 8
"""Rows of a film that are rendered together where pixels share samples."""


class Ranks:
    """The processes of a job that `torchrun` started, or this one alone.

    Each renders every `count`-th row of the film, or band of rows. A context that leaves the job at its end. All methods that
    return something of all ranks are collective: every rank calls them, in the same order.
    """

    def __init__(self) -> None:
        self.rank, self.count, self._device = 0, 1, torch.device("cpu")

    @classmethod
    def join(cls, device: str) -> Ranks:
        """This process among those that torchrun started, by its environment variables; alone where there are none.

        Raises BokehguideError where the others do not answer.
        """
        ranks = cls()
        if int(os.environ.get("WORLD_SIZE", "1")) > 1:
            try:
                store, rank, count = next(dist.rendezvous("env://"))
                # torchrun keeps the store when it starts the job again: the addresses of dead ranks are in it.
                store = dist.PrefixStore(f"start {restarts()}", store)
                dist.init_process_group("nccl" if device == "cuda" else "gloo", store=store, rank=rank, world_size=count)
            except (RuntimeError, ValueError) as error:
                raise _lost(error) from error
            ranks.rank, ranks.count = rank, count
            if device == "cuda":
                ranks._device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
                torch.cuda.set_device(ranks._device)
        return ranks

    def __enter__(self) -> Ranks:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.alone:
            dist.destroy_process_group()

    @property
    def first(self) -> bool:
        """Whether this is the rank that writes and speaks."""
        return self.rank == 0

    @property
    def alone(self) -> bool:
        return self.count == 1

    def rows(self, width: int, height: int, band: int, device: torch.device) -> Tensor | None:
        """This rank's pixels of a film, bands of `band` rows, int64 `[N]`; None where it has all."""
        if self.alone:
            return None
        rows = torch.arange(height, device=device)
        rows = rows[rows // band % self.count == self.rank]
        return (rows[:, None] * width + torch.arange(width, device=device)).flatten()

    def total(self, values: Tensor) -> Tensor:
        """The sum over the ranks, on every rank; alone, the values themselves."""
        return self._reduced(values, dist.ReduceOp.SUM)

    def totals(self, *values: float) -> list[float]:
        """The sums over the ranks of some numbers."""
        return list(values) if self.alone else self.total(torch.tensor(values, dtype=torch.float64)).tolist()

    def any(self, *flags: bool) -> list[bool]:
        """Which flags are set on some rank."""
        if self.alone:
            return list(flags)
        return self._reduced(torch.tensor(flags, dtype=torch.int32), dist.ReduceOp.MAX).bool().tolist()

    def gathered(self, value: object) -> list:
        """The value of every rank, in their order; small ones only."""
        if self.alone:
            return [value]
        values: list = [None] * self.count
        try:
            dist.all_gather_object(values, value)
        except RuntimeError as error:
            raise _lost(error) from error
        return values

    def merged(self, state: Mapping[str, object], mine: Tensor) -> dict[str, object]:
        """A state dict with every pixel's entries from the rank that renders it, and all else from this one.

        mine: bool `[pixels]`; tensors whose last dimension is as long have an entry for each pixel.
        """
        merged = dict(state)
        for name, value in () if self.alone else state.items():
            if isinstance(value, Mapping):
                merged[name] = self.merged(value, mine)
            elif isinstance(value, Tensor) and value.shape[-1:] == mine.shape:
                own = torch.where(mine.to(value.device), value, torch.zeros_like(value))
                merged[name] = self.total(own.byte() if value.dtype == torch.bool else own).to(value.dtype)
        return merged

    def _reduced(self, values: Tensor, how: dist.ReduceOp) -> Tensor:
        if self.alone:
            return values
        reduced = values.detach().to(self._device, copy=True)
        try:
            dist.all_reduce(reduced, how)
        except RuntimeError as error:
            raise _lost(error) from error
        return reduced.to(values.device)


def available_cores() -> int:
    """Cores for this rank: of those that the process may run on, its share among the ranks on this machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")), 1)


def restarts() -> int:
    """How often torchrun has started this job again after a rank had died."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


def _lost(error: Exception) -> BokehguideError:
    reason = re.sub(r"\[[^]]*\] ?", "", str(error).strip().splitlines()[0]).split(". ")[0].strip()
    return BokehguideError(
        f"torchrun: another rank has ended or does not answer ({reason}); "
        "see its message, and start the job again with --resume"
    )
