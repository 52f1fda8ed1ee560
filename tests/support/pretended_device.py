"""A simulated device: tensors that report another device, and whose numbers are on the CPU.

All that runs with `--device cuda` runs there with real numbers and the real Embree. What mixes devices fails, as it would on
CUDA; what the host would have to wait for is counted.
"""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import torch
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

import bokehguide
from bokehguide.runtime import device, indexing

aten = torch.ops.aten
NAME = "pretended"
PACKAGE = Path(bokehguide.__file__).parent
WAITED_FOR = {
    aten._local_scalar_dense.default,
    aten.nonzero.default,
    aten.masked_select.default,
    aten.repeat_interleave.Tensor,
    aten.bincount.default,
    aten.equal.default,
}
"""Operations whose results the host needs, or the size of their results."""
waits: Counter[str] = Counter()
"""How often the host would have waited, by the function that made it wait."""
_waited: Counter[int] = Counter()
"""How often in each thread, since the beginning."""
_lock = threading.Lock()
_registered: set[str] = set()


class OnDevice(torch.Tensor):
    """A tensor that says it is on the device."""

    @staticmethod
    def __new__(cls, data: torch.Tensor):
        layout = {"strides": data.stride(), "storage_offset": data.storage_offset(), "dtype": data.dtype}
        return torch.Tensor._make_wrapper_subclass(cls, data.shape, device=torch.device(NAME, 0), **layout)

    def __init__(self, data: torch.Tensor):
        self.data_on_host = data

    def tolist(self) -> list:
        return self.cpu().tolist()

    def __format__(self, spec: str) -> str:
        return format(self.item(), spec)

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _run(function, args, kwargs or {})


class _Mode(TorchDispatchMode):
    """Makes tensors on the device too: what is asked for there has no tensor on it among its arguments."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _run(function, args, kwargs or {})


@contextmanager
def pretended_device() -> Iterator[str]:
    """The name of a device that is there, in this thread and in all that `enter` is called in, while this lasts."""
    if NAME not in _registered:
        _registered.add(NAME)
        _setup_privateuseone_for_python_backend(NAME)
    waits.clear()
    torch._C._set_only_lift_cpu_tensors(True)  # what `torch.tensor` makes is copied to the device like all else
    try:
        with _Mode(), patch.object(device, "HostCopy", _Coming), patch.object(indexing, "HostCopy", _Coming):
            yield NAME
    finally:
        torch._C._set_only_lift_cpu_tensors(False)


class _Coming(device.HostCopy):
    """Who asks for it before the host has waited for anything else waits for it."""

    def __init__(self, values: torch.Tensor):
        super().__init__(values)
        self._waited = _waited.copy()

    def get(self) -> torch.Tensor:
        if self._waited == _waited:
            _count(None)
        return super().get()


def enter() -> None:
    """Let this thread make tensors on the device, for good."""
    torch._C._set_only_lift_cpu_tensors(True)
    _Mode().__enter__()


def _run(function, args: tuple, kwargs: dict):
    leaves = pytree.tree_leaves((args, kwargs))
    there = [leaf for leaf in leaves if isinstance(leaf, OnDevice)]
    here = [leaf for leaf in leaves if isinstance(leaf, torch.Tensor) and not isinstance(leaf, OnDevice)]
    asked = kwargs.get("device")
    if function in (aten._to_copy.default, aten.copy_.default):
        return _copied(function, args, kwargs)
    joined = function in (aten.stack.default, aten.cat.default)  # else what has no dimensions may come from the CPU
    if there and any(joined or tensor.ndim > 0 for tensor in here) and function is not aten.index.Tensor:
        raise RuntimeError(f"{function}: tensors here and there at {_place()}")
    if there and _is_waited_for(function, args, kwargs):
        _count(function)
    made = _on_host(function, args, kwargs)
    on_device = torch.device(asked).type == NAME if asked is not None else bool(there)
    if not on_device:
        return made
    known = {id(leaf.data_on_host): leaf for leaf in there}  # what was changed in place is the same tensor as before
    return pytree.tree_map_only(torch.Tensor, lambda value: known[id(value)] if id(value) in known else OnDevice(value), made)


def _is_waited_for(function, args: tuple, kwargs: dict) -> bool:
    if function is aten.repeat_interleave.Tensor and kwargs.get("output_size") is not None:
        return False
    return function in WAITED_FOR or (function is aten.index.Tensor and _masks(args[1]))


def _masks(index: object) -> bool:
    return any(isinstance(part, torch.Tensor) and part.dtype in (torch.bool, torch.uint8) for part in index)


def _on_host(function, args: tuple, kwargs: dict):
    args, kwargs = pytree.tree_map_only(OnDevice, lambda tensor: tensor.data_on_host, (args, kwargs))
    if kwargs.get("device") is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    return function(*args, **kwargs)


def _copied(function, args: tuple, kwargs: dict):
    """Between devices: the host waits for what it gets, unless it says that it does not."""
    if function is aten.copy_.default:
        later = kwargs.get("non_blocking", args[2] if len(args) > 2 else False)
        if isinstance(args[1], OnDevice) and not isinstance(args[0], OnDevice) and not later:
            _count(function)
        _on_host(function, args, kwargs)
        return args[0]
    target = kwargs.get("device")
    from_device = isinstance(args[0], OnDevice)
    to_device = from_device if target is None else torch.device(target).type == NAME
    if from_device != to_device and not kwargs.get("non_blocking"):
        _count(function)
    made = _on_host(function, args, {**kwargs, "non_blocking": False})
    return OnDevice(made) if to_device else made


def _count(function) -> None:
    with _lock:
        waits[_place()] += 1
        _waited[threading.get_ident()] += 1


def _place() -> str:
    """The function of the package that called, and its line."""
    frame = sys._getframe(1)
    while frame is not None:
        path, function = Path(frame.f_code.co_filename), frame.f_code.co_name
        if PACKAGE in path.parents and function != "indices":
            return f"{path.stem}.{function}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere:0"
