"""Transfers between the host and the device. The host traces rays with Embree, and the device does all other work."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from bokehguide.errors import BokehguideError

_thread = threading.local()
"""`stream`: the CUDA stream of the thread."""


def check_device(device: str) -> None:
    """Raise BokehguideError if torch finds no such device."""
    if device == "cuda" and not torch.cuda.is_available():
        raise BokehguideError("device: cuda: torch finds no CUDA device here; give cpu")


def free_memory(device: torch.device) -> float:
    """Bytes of a GPU that PyTorch may take or holds unused; infinity for other devices."""
    if device.type != "cuda":
        return math.inf
    held = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + held


def to_host(*tensors: Tensor) -> list[Tensor]:
    """Copies on the host of tensors `[.., N]` with the same N and type. The host waits for the copies.

    Tensors on a CPU are returned without a copy. All other tensors are copied in one transfer.
    """
    if tensors[0].device.type == "cpu":
        return list(tensors)
    heights = [math.prod(tensor.shape[:-1]) for tensor in tensors]
    rows = torch.cat([tensor.reshape(height, tensor.shape[-1]) for height, tensor in zip(heights, tensors)])
    copied = torch.empty(rows.shape, dtype=rows.dtype, pin_memory=rows.is_cuda).copy_(rows)
    return [part.reshape(tensor.shape) for part, tensor in zip(copied.split(heights), tensors)]


def to_device(values: Tensor | np.ndarray | Sequence | float, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """A tensor on a device with values from the host. The host does not wait for the transfer."""
    return torch.as_tensor(values, dtype=dtype).to(device, non_blocking=True)


class HostCopy:
    """A copy of a tensor on the host. The transfer runs while the host does other work.

    `get` does not wait if the host has already waited for a later operation on the same stream.
    """

    def __init__(self, values: Tensor):
        self._copy, self._event = torch.empty(values.shape, dtype=values.dtype, pin_memory=values.is_cuda), None
        self._copy.copy_(values, non_blocking=True)
        if values.is_cuda:
            self._event = torch.cuda.Event()
            self._event.record()

    def get(self) -> Tensor:
        """Wait for the end of the transfer, and return the copy."""
        if self._event is not None:
            self._event.synchronize()
        return self._copy


@contextmanager
def own_stream(device: torch.device) -> Iterator[None]:
    """A context in which the thread launches CUDA work on its own stream, concurrently with the streams of other threads.

    The work starts after all work launched so far on the thread's current stream; later work on that stream waits for it.
    On other devices the context does nothing.
    """
    if device.type != "cuda":
        yield
        return
    if not hasattr(_thread, "stream"):
        _thread.stream = torch.cuda.Stream(device)
    common = torch.cuda.current_stream(device)
    _thread.stream.wait_stream(common)
    with torch.cuda.stream(_thread.stream):
        yield
    common.wait_stream(_thread.stream)
