"""Element-wise functions compiled ahead of time, once per machine.

A kernel is a function marked with the decorator `kernel`. In eager mode, PyTorch runs a kernel operation by operation and writes
every intermediate result to memory. torch.export and AOTInductor can compile a kernel into a loop that keeps intermediate results
in registers, about ten times as fast. Compilation takes seconds per kernel. Compiled packages are kept on disk, and loading takes
milliseconds. Kernels run eagerly outside of `compile_kernels`, on devices other than a CPU, and without a C++ compiler. The eager
functions are the reference. Compiled results differ from eager results only by rounding.
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
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import platformdirs
import torch
from torch import Tensor

from bokehguide import __version__

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

SOURCES = Path(__file__).parents[2]
"""Folder of the package, whose source code decides whether a compiled package is valid."""


class _Setting(NamedTuple):
    """threads: number of threads that run kernels concurrently. folder: of the compiled packages."""

    threads: int
    folder: Path


_setting: ContextVar[_Setting | None] = ContextVar("compile setting", default=None)
"""Compile setting of this thread. None: kernels run eagerly."""
_lock = threading.Lock()
"""Lock for the time in which a kernel is compiled or loaded."""


@contextlib.contextmanager
def compile_kernels(threads: int, folder: Path | None = None) -> Iterator[None]:
    """A context in which the calling thread compiles kernels at their first use.

    threads: number of threads that run kernels concurrently; 0: kernels run eagerly. folder: of the compiled packages, by
    default in the user's cache folder.
    """
    setting = None
    if threads > 0:
        setting = _Setting(threads, folder or platformdirs.user_cache_path("bokehguide") / "kernels")
    token = _setting.set(setting)
    try:
        yield
    finally:
        _setting.reset(token)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Mark a pure function of positional arguments as a kernel.

    Arguments and results are tensors, tuples, `record`s or None. Arguments of other types become constants of the compiled code:
    each value is compiled separately. Last dimensions may have any size. All results must have the same last dimension.
    """
    return cast("Callable[P, R]", functools.wraps(function)(_Kernel(function)))


_records: set[type] = set()


def record(kind: type[T]) -> type[T]:
    """Allow instances of a class as arguments and results of kernels. Kernels treat instances as tuples of their attributes."""
    _records.add(kind)
    return kind


def _flatten(value: object, tensors: list[Tensor], marks: list) -> None:
    """Append the tensors in `value` to `tensors`, and its structure and constants to `marks`."""
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


def _rebuilt(like: Any, tensors: Iterator[Tensor]) -> Any:
    """A value of the same structure and constants as `like`, with other tensors."""
    if isinstance(like, Tensor):
        return next(tensors)
    if isinstance(like, tuple):
        parts = [_rebuilt(part, tensors) for part in like]
        return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)
    if type(like) in _records:
        copy = object.__new__(type(like))
        vars(copy).update((name, _rebuilt(part, tensors)) for name, part in vars(like).items())
        return copy
    return like


class _Kernel:
    """A kernel with its compiled variants, by number of threads, structure of the arguments, and tensors with a single entry."""

    def __init__(self, function: Callable):
        self._function = function
        self._variants: dict[tuple[int, tuple, tuple[bool, ...]], _Variant | _AsTwo | None] = {}

    def __call__(self, *arguments: Any) -> Any:
        setting = _setting.get()
        if setting is None:
            return self._function(*arguments)
        tensors, marks = [], []
        _flatten(arguments, tensors, marks)
        if tensors[0].device.type != "cpu" or any(tensor.numel() == 0 for tensor in tensors):
            return self._function(*arguments)
        key = setting.threads, tuple(marks), tuple(tensor.shape[-1:] == _ONE for tensor in tensors)
        if key not in self._variants:
            with _lock:
                if key not in self._variants:
                    self._variants[key] = self._as_two(*key) or _variant(
                        self._function, arguments, tensors, repr(key[1:]), setting
                    )
        variant = self._variants[key]
        return self._function(*arguments) if variant is None else variant(tensors)

    def _as_two(self, threads: int, marks: tuple, single: tuple[bool, ...]) -> _AsTwo | None:
        """The variant for larger batches, applied to a batch of one entry; None without such a variant."""
        for (*other, some), variant in self._variants.items():
            if (
                isinstance(variant, _Variant)
                and other == [threads, marks]
                and single == tuple(map(operator.or_, some, variant.batched))
            ):
                return _AsTwo(variant)
        return None


class _Variant:
    """A compiled kernel for one structure of arguments.

    run: the compiled function of the arguments' tensors. tensors, results: an example. batched: which tensors have the last
    dimension of the results.
    """

    def __init__(self, run: Callable[[list[Tensor]], list[Tensor]], tensors: list[Tensor], results: object):
        self._run = run
        self._results = _rebuilt(results, itertools.repeat(torch.empty(0)))
        found: list[Tensor] = []
        _flatten(results, found, [])
        self.batched = [tensor.shape[-1:] == found[0].shape[-1:] for tensor in tensors]

    def __call__(self, tensors: list[Tensor], entries: slice = slice(None)) -> Any:
        """The results at the `entries`."""
        results = self._run(tensors)
        return _rebuilt(self._results, (result[..., entries] for result in results))


class _AsTwo:
    """The variant for larger batches, applied to a batch of one entry by repeating the entry.

    This saves seconds of compilation, and results do not depend on how pixels are cut into batches.
    """

    def __init__(self, variant: _Variant):
        self._variant = variant

    def __call__(self, tensors: list[Tensor]) -> Any:
        pairs = zip(tensors, self._variant.batched)
        return self._variant([torch.cat((tensor, tensor), -1) if batched else tensor for tensor, batched in pairs], slice(1))


class _Flat(torch.nn.Module):
    """The function as a module whose arguments are a flat list of tensors. `as_floats` has reinterpreted integer tensors."""

    def __init__(self, function: Callable, arguments: tuple, kinds: list[torch.dtype]):
        super().__init__()
        self._function, self._arguments, self._kinds = function, arguments, kinds

    def forward(self, *tensors: Tensor) -> list[Tensor]:
        results: list[Tensor] = []
        given = (tensor.view(kind) for tensor, kind in zip(tensors, self._kinds))
        _flatten(self._function(*_rebuilt(self._arguments, given)), results, [])
        return results


def _variant(function: Callable, arguments: tuple, tensors: list[Tensor], key: str, setting: _Setting) -> _Variant | None:
    """The compiled function, from disk if the package exists; None if the compilation fails."""
    with torch.no_grad():
        results = function(*arguments)
    name = f"{function.__module__}.{function.__qualname__}"
    path = setting.folder / f"{name}-{hashlib.sha256(f'{_state()} {name} {key}'.encode()).hexdigest()[:24]}.pt2"
    try:
        from bokehguide.runtime.compile.compiled import CompiledFunction, as_floats
        from bokehguide.runtime.compile.compiling import compile_package

        if not path.exists():
            if not _has_compiler():
                return None
            _announce(setting.folder)
            # Copies: torch.export would merge arguments that are the same tensor.
            copies = tuple(as_floats(tensor.clone(memory_format=torch.contiguous_format)) for tensor in tensors)
            flat = _Flat(function, arguments, [tensor.dtype for tensor in tensors])
            compile_package(flat, copies, path)
        return _Variant(CompiledFunction(path, setting.threads), tensors, results)
    except Exception as error:  # compilers raise many types, and the eager function gives the same picture
        with contextlib.suppress(OSError):  # the folder may be inaccessible
            path.unlink()
        reason = str(error).strip().splitlines() or [type(error).__name__]
        print(f"bokehguide: {name} is not compiled ({reason[0][:120]}); it runs more slowly", file=sys.stderr)
        return None


@functools.cache
def _has_compiler() -> bool:
    """Whether there is a C++ compiler. The first call prints a message if the compiler is missing."""
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        get_cpp_compiler()
    except RuntimeError:
        message = "there is no C++ compiler, so that kernels are not compiled; install g++ or clang++, or name one in CXX"
        print(f"bokehguide: {message}", file=sys.stderr)
    else:
        return True
    return False


@functools.cache
def _announce(folder: Path) -> None:
    print(f"bokehguide: compiling kernels, once on this machine; they are kept in {folder}", file=sys.stderr)


@functools.cache
def _state() -> str:
    """The versions and sources on which compiled code depends, in addition to the structure of the arguments."""
    sources = hashlib.sha256()
    for file in sorted(SOURCES.rglob("*.py")):
        sources.update(file.read_bytes())
    return f"{__version__} {torch.__version__} {torch.backends.cpu.get_cpu_capability()} {sources.hexdigest()}"
