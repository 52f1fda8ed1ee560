"""Between the host, where Embree traces, and the device that all else is on."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

_of_thread = threading.local()


def fetched(*tensors: Tensor) -> list[Tensor]:
    """Tensors `[.., N]` of the same N and type, on the host, which waits for them; from a CPU they are not copied, from other
    devices all go together."""
    if tensors[0].device.type == "cpu":
        return list(tensors)
    heights = [math.prod(tensor.shape[:-1]) for tensor in tensors]
    rows = torch.cat([tensor.reshape(height, tensor.shape[-1]) for height, tensor in zip(heights, tensors)])
    there = torch.empty(rows.shape, dtype=rows.dtype, pin_memory=rows.is_cuda).copy_(rows)
    return [part.reshape(tensor.shape) for part, tensor in zip(there.split(heights), tensors)]


def sent(values: Tensor | np.ndarray | Sequence, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """Values of the host's as a tensor on a device, for which the host does not wait."""
    return torch.as_tensor(values, dtype=dtype).to(device, non_blocking=True)


class Coming:
    """A tensor on its way to the host, which may do other things before it asks for it. Once it has waited for anything that
    was asked for later, it does not wait for this any more."""

    def __init__(self, values: Tensor):
        self._there, self._event = torch.empty(values.shape, dtype=values.dtype, pin_memory=values.is_cuda), None
        self._there.copy_(values, non_blocking=True)
        if values.is_cuda:
            self._event = torch.cuda.Event()
            self._event.record()

    def get(self) -> Tensor:
        if self._event is not None:
            self._event.synchronize()
        return self._there


@contextmanager
def own_stream(device: torch.device) -> Iterator[None]:
    """What this thread asks of a GPU runs beside what others ask, and beside their transfers: after what was asked for before,
    and before what is asked for afterwards. Elsewhere nothing changes."""
    if device.type != "cuda":
        yield
        return
    if not hasattr(_of_thread, "stream"):
        _of_thread.stream = torch.cuda.Stream(device)
    common = torch.cuda.current_stream(device)
    _of_thread.stream.wait_stream(common)
    with torch.cuda.stream(_of_thread.stream):
        yield
    common.wait_stream(_of_thread.stream)
