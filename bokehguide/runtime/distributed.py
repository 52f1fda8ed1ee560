"""Ranks: several processes that render one picture together."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Any, Self

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.rendezvous import rendezvous

from bokehguide.errors import BokehguideError

ROWS_PER_BAND = 8
"""Number of consecutive film rows that one rank renders in modes in which pixels reuse samples."""


class Ranks:
    """The processes of a job that `torchrun` started, or this process alone.

    The object is a context manager that leaves the job at its end. Each rank renders every `count`-th row, or band of rows, of
    the film. Methods that combine values of all ranks are *collective*: every rank must call them, in the same order. A
    collective method raises BokehguideError if another rank does not answer.
    """

    def __init__(self) -> None:
        self.rank, self.count, self._device = 0, 1, torch.device("cpu")

    @classmethod
    def join(cls, device: str) -> Ranks:
        """Join the job that the environment variables of torchrun describe. Without the variables, this process is the only rank.

        device: "cpu" or "cuda". On "cuda", each rank uses the GPU with its local number.
        """
        ranks = cls()
        if int(os.environ.get("WORLD_SIZE", "1")) > 1:
            # The module has the process group of its first import in default arguments. Imported later, e.g. by an optimiser, it
            # would keep Gloo's threads beyond `__exit__`. Such a thread can abort the process while the interpreter ends.
            import torch.distributed.nn

            try:
                store, rank, count = next(iter(rendezvous("env://")))
                # After a restart, torchrun's store still has the addresses of the ranks that died.
                store = dist.PrefixStore(f"start {restarts()}", store)  # pyright: ignore[reportPrivateImportUsage]
                dist.init_process_group("nccl" if device == "cuda" else "gloo", store=store, rank=rank, world_size=count)
            except (RuntimeError, ValueError) as error:
                raise _lost(error) from error
            ranks.rank, ranks.count = rank, count
            if device == "cuda":
                ranks._device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
                torch.cuda.set_device(ranks._device)
        return ranks

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.alone:
            dist.destroy_process_group()

    @property
    def first(self) -> bool:
        """Whether this rank writes files and messages."""
        return self.rank == 0

    @property
    def alone(self) -> bool:
        """Whether there is one rank."""
        return self.count == 1

    def rows(self, width: int, height: int, band: int, device: torch.device) -> Tensor | None:
        """Pixels of a film that this rank renders, in bands of `band` rows, int64 `[N]`; None for all pixels."""
        if self.alone:
            return None
        rows = torch.arange(height, device=device)
        rows = rows[rows // band % self.count == self.rank]
        return (rows[:, None] * width + torch.arange(width, device=device)).flatten()

    def total(self, values: Tensor) -> Tensor:
        """Sum of the values over the ranks. A single rank gets the same values without a copy."""
        return self._reduced(values, dist.ReduceOp.SUM)

    def totals(self, *values: float) -> list[float]:
        """The sum of each number over the ranks."""
        return list(values) if self.alone else self.total(torch.tensor(values, dtype=torch.float64)).tolist()

    def any(self, *flags: bool) -> list[bool]:
        """Whether each flag is set on any rank."""
        if self.alone:
            return list(flags)
        return self._reduced(torch.tensor(flags, dtype=torch.int32), dist.ReduceOp.MAX).bool().tolist()

    def gathered(self, value: object) -> list:
        """The value of every rank, by rank. Values are pickled and should be small."""
        if self.alone:
            return [value]
        values: list = [None] * self.count
        try:
            dist.all_gather_object(values, value)
        except RuntimeError as error:
            raise _lost(error) from error
        return values

    def merged(self, state: Mapping[str, Any], mine: Tensor) -> dict[str, Any]:
        """A state dict in which each pixel's entries come from the rank that renders the pixel. Other values come from this rank.

        mine: the pixels of this rank, bool `[pixels]`. If the last dimension of a tensor has this length, the tensor has an entry
        for each pixel.
        """
        merged = dict(state)
        for name, value in () if self.alone else state.items():
            if isinstance(value, Mapping):
                merged[name] = self.merged(value, mine)
            elif isinstance(value, Tensor) and value.shape[-1:] == mine.shape:
                own = torch.where(mine.to(value.device), value, torch.zeros_like(value))
                merged[name] = self.total(own.byte() if value.dtype == torch.bool else own).to(value.dtype)
        return merged

    def _reduced(self, values: Tensor, operation: dist.ReduceOp.RedOpType) -> Tensor:
        if self.alone:
            return values
        reduced = values.detach().to(self._device, copy=True)
        try:
            dist.all_reduce(reduced, operation)
        except RuntimeError as error:
            raise _lost(error) from error
        return reduced.to(values.device)


class RankSums(nn.Module):
    """Sums over the samples of all ranks. Each rank adds its own samples.

    sums: buffer with the sums of all ranks up to the last `merge`. mine: tensor to which this rank adds its samples.
    """

    sums: Tensor
    _own: Tensor | None

    def __init__(self, sums: Tensor, ranks: Ranks | None = None):
        super().__init__()
        self.ranks = ranks or Ranks()
        self.register_buffer("sums", sums)
        self.register_buffer("_own", None if self.ranks.alone else torch.zeros_like(sums), persistent=False)

    @property
    def mine(self) -> Tensor:
        return self.sums if self._own is None else self._own

    def merge(self) -> None:
        """Add the samples of all ranks to the sums of every rank; collective."""
        if self._own is not None:
            self.sums += self.ranks.total(self._own)
            self._own.zero_()

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        """Load the sums, and discard samples that were added since the last `merge`."""
        super()._load_from_state_dict(*args, **kwargs)
        if self._own is not None:
            self._own.zero_()


def available_cores() -> int:
    """Number of cores for this rank: the cores that the process may use, divided by the number of ranks on this machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")), 1)


def restarts() -> int:
    """How often torchrun has restarted this job after the death of a rank."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


def _lost(error: Exception) -> BokehguideError:
    reason = re.sub(r"\[[^]]*\] ?", "", str(error).strip().splitlines()[0]).split(". ")[0].strip()
    return BokehguideError(
        f"torchrun: another rank has ended or does not answer ({reason}); see its message, and start the job again with --resume"
    )
