"""Element-wise arithmetic compiled ahead of time, once for a machine.

Eager PyTorch writes every intermediate result to memory. Functions of tensors that are marked `kernel` may be compiled
(torch.export and AOTInductor) into loops that keep them in registers, which is about ten times as fast. What is compiled
is kept on disk, because compiling takes seconds for each and loading takes milliseconds. Until `compile_kernels` is
called, on other devices than CPUs, and where there is no C++ compiler, they run eagerly: the functions themselves are
the reference, and results agree but for rounding.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import operator
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import platformdirs
import torch
from torch import Tensor

from bokehguide import __version__

SOURCES = tuple(Path(__file__).parent.parent / name for name in ("render", "models", "restir", "train"))
"""Folders of the code that kernels are made of."""


class _Compiling:
    """Whether kernels are compiled, for all of the process: how many threads run them; where they are kept."""

    threads = 0
    folder: Path | None = None
    announced = False
    lock = threading.Lock()


def compile_kernels(threads: int, folder: Path | None = None) -> None:
    """From now on compile kernels when they are first used, for so many threads; 0: run eagerly again.

    folder: where they are kept, by default the user's cache folder.
    """
    _Compiling.threads = threads
    _Compiling.folder = folder or platformdirs.user_cache_path("bokehguide") / "kernels"


def kernel(function: Callable) -> Callable:
    """Mark a pure function that is to be compiled.

    Its arguments are tensors, tuples and `record`s of them, None, or values that are part of the code: each different one
    is compiled anew. Last dimensions may be of any size, those of results are all the same. Results are the same kinds of things.
    """
    return functools.wraps(function)(_Kernel(function))


_records: set[type] = set()


def record(kind: type) -> type:
    """Let objects of a class be arguments and results of kernels, as the tuples of their attributes that they are."""
    _records.add(kind)
    return kind


def _flatten(value: object, tensors: list[Tensor], marks: list) -> None:
    """Append the tensors in `value`, and what else of it is part of the code, in the same order for the same structure."""
    if isinstance(value, Tensor):
        shape = value.shape
        tensors.append(value)
        marks.append((value.dtype, shape[:-1] if len(shape) > 1 else len(shape)))
    elif isinstance(value, tuple):
        marks.append((type(value), len(value)))
        for part in value:
            _flatten(part, tensors, marks)
    elif type(value) in _records:
        parts = vars(value)
        marks.append((type(value), *parts))
        for part in parts.values():
            _flatten(part, tensors, marks)
    else:
        marks.append(value)


_ONE = torch.Size([1])


def _rebuilt(like: object, tensors: Iterator[Tensor]) -> object:
    """What `_flatten` was given, with other tensors."""
    if isinstance(like, Tensor):
        return next(tensors)
    if isinstance(like, tuple):
        parts = [_rebuilt(part, tensors) for part in like]
        return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)
    if type(like) in _records:
        made = object.__new__(type(like))
        vars(made).update((name, _rebuilt(part, tensors)) for name, part in vars(like).items())
        return made
    return like


class _Kernel:
    def __init__(self, function: Callable):
        self._function = function
        self._variants: dict[object, _Variant | _AsTwo | None] = {}

    def __call__(self, *arguments):
        if _Compiling.threads == 0:
            return self._function(*arguments)
        tensors, marks = [], []
        _flatten(arguments, tensors, marks)
        if tensors[0].device.type != "cpu" or any(tensor.numel() == 0 for tensor in tensors):
            return self._function(*arguments)
        key = tuple(marks), tuple(tensor.shape[-1:] == _ONE for tensor in tensors)
        if key not in self._variants:
            with _Compiling.lock:
                if key not in self._variants:
                    self._variants[key] = self._as_two(*key) or _variant(self._function, arguments, tensors, repr(key))
        variant = self._variants[key]
        return self._function(*arguments) if variant is None else variant(tensors)

    def _as_two(self, marks: tuple, single: tuple[bool, ...]) -> _AsTwo | None:
        """For a batch of one, the variant for larger ones, if there is one."""
        for (other, some), variant in self._variants.items():
            if isinstance(variant, _Variant) and other == marks and single == tuple(map(operator.or_, some, variant.batched)):
                return _AsTwo(variant)
        return None


class _Variant:
    """A compiled kernel for one structure of arguments.

    run: of their tensors; tensors, results: some that it had. batched: which of the tensors are as long as the results.
    """

    def __init__(self, run: Callable[[list[Tensor]], list[Tensor]], tensors: list[Tensor], results: object):
        self._run = run
        self._results = _rebuilt(results, itertools.repeat(torch.empty(0)))
        found: list[Tensor] = []
        _flatten(results, found, [])
        self.batched = [tensor.shape[-1:] == found[0].shape[-1:] for tensor in tensors]

    def __call__(self, tensors: list[Tensor], shown: slice = slice(None)):
        """Its results, as far as they are `shown`."""
        results = self._run(tensors)
        return _rebuilt(self._results, (result[..., shown] for result in results))


class _AsTwo:
    """A kernel for a batch of one: that for larger ones, given it twice. It would not pay to compile another one, which takes
    seconds, and results are the same to the bit however pixels are cut into batches."""

    def __init__(self, variant: _Variant):
        self._variant = variant

    def __call__(self, tensors: list[Tensor]):
        pairs = zip(tensors, self._variant.batched)
        return self._variant([torch.cat((tensor, tensor), -1) if batched else tensor for tensor, batched in pairs], slice(1))


class _Flat(torch.nn.Module):
    """The function of a flat list of tensors, whole numbers among them `as_floats`."""

    def __init__(self, function: Callable, arguments: tuple, kinds: list[torch.dtype]):
        super().__init__()
        self._function, self._arguments, self._kinds = function, arguments, kinds

    def forward(self, *tensors: Tensor) -> list[Tensor]:
        results: list[Tensor] = []
        given = (tensor.view(kind) for tensor, kind in zip(tensors, self._kinds))
        _flatten(self._function(*_rebuilt(self._arguments, given)), results, [])
        return results


def _variant(function: Callable, arguments: tuple, tensors: list[Tensor], key: str) -> _Variant | None:
    """The compiled function, from disk if it is there; None where it cannot be compiled."""
    with torch.no_grad():
        results = function(*arguments)
    name = f"{function.__module__}.{function.__qualname__}"
    path = _Compiling.folder / f"{name}-{hashlib.sha256(f'{_state()} {name} {key}'.encode()).hexdigest()[:24]}.pt2"
    try:
        from bokehguide.render.compiled import CompiledFunction, as_floats
        from bokehguide.render.compiling import compile_package

        if not path.exists():
            if not _has_compiler():
                return None
            _announce()
            # Copies: of one tensor that is given twice, torch.export would make one argument.
            copies = tuple(as_floats(tensor.clone(memory_format=torch.contiguous_format)) for tensor in tensors)
            flat = _Flat(function, arguments, [tensor.dtype for tensor in tensors])
            compile_package(flat, copies, path)
        return _Variant(CompiledFunction(path, _Compiling.threads), tensors, results)
    except Exception as error:  # whatever a compiler may fail with: pictures come out the same without it
        with contextlib.suppress(OSError):  # the folder itself may be what is wrong
            path.unlink()
        reason = str(error).strip().splitlines() or [type(error).__name__]
        print(f"bokehguide: {name} is not compiled ({reason[0][:120]}); it runs more slowly", file=sys.stderr)
        return None


@functools.cache
def _has_compiler() -> bool:
    """Whether there is a C++ compiler; says so once where there is none, before seconds of work for each kernel."""
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        get_cpp_compiler()
    except RuntimeError:
        told = "there is no C++ compiler, so that kernels are not compiled; install g++ or clang++, or name one in CXX"
        print(f"bokehguide: {told}", file=sys.stderr)
    else:
        return True
    return False


def _announce() -> None:
    if not _Compiling.announced:
        _Compiling.announced = True
        print(f"bokehguide: compiling kernels, once on this machine; they are kept in {_Compiling.folder}", file=sys.stderr)


@functools.cache
def _state() -> str:
    """What compiled code depends on beside its arguments."""
    sources = hashlib.sha256()
    for file in sorted(file for folder in SOURCES for file in folder.glob("*.py")):
        sources.update(file.read_bytes())
    return f"{__version__} {torch.__version__} {torch.backends.cpu.get_cpu_capability()} {sources.hexdigest()}"
