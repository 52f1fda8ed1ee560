"""Compilation of functions of tensors by AOTInductor into packages for `compiled.py`."""

from __future__ import annotations

import contextlib
import os
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from bokehguide.runtime.compile.compiled import ARGUMENTS
from bokehguide.runtime.compile.rows import ByRows

LARGEST_FIXED = 4
"""Largest tensor size that compiled code may contain as a constant. Matrices have such constant sizes."""
HEADERS = Path(__file__).parent / "headers"
"""Headers that replace headers of the C++ standard library. Each header explains its reason."""
OPTIONS = {
    "cpp.threads": 1,
    "aot_inductor.compile_wrapper_opt_level": "O0",
    "cpp.max_horizontal_fusion_size": 4096,
    "max_fusion_size": 4096,
    "assert_indirect_indexing": False,
}
"""Options of Inductor. The wrapper that calls the loops is compiled without optimisation. A whole kernel may become one loop.
Compiled code does not check indices into tables, because a check takes as long as a lookup. Eager kernels check the indices."""


def compile_package(function: torch.nn.Module, tensors: tuple[Tensor, ...], path: Path) -> None:
    """Compile a function of distinct contiguous tensors that returns a list of tensors.

    The compiled function accepts any last dimension above 1. Raises the errors of PyTorch and of the C++ compiler, and
    RuntimeError if the code depends on a size.
    """
    from torch._inductor.exc import InductorError  # a private module, which may move

    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with _searched_first(HEADERS), _bits_in_registers():
            _package(function, tensors, path)
    except (InductorError, ImportError, AttributeError):  # this PyTorch does not fit the headers or the replaced method
        _package(function, tensors, path)


def _package(function: torch.nn.Module, tensors: tuple[Tensor, ...], path: Path) -> None:
    from torch._inductor import aoti_compile_and_package, config

    temporary = path.with_suffix(f".{os.getpid()}.pt2")
    with warnings.catch_warnings(), torch.no_grad(), config.patch(OPTIONS):
        warnings.simplefilter("ignore")
        program = _exported(function, tensors)
        _check_sizes(program)
        graph = core_graph(program)
        graph.graph.eliminate_dead_code()
        needed = [number for number, node in enumerate(graph.graph.find_nodes(op="placeholder")) if node.users]
        program = _exported(_ByRows(graph, needed, len(tensors)), tuple(tensors[number] for number in needed))
        _check_sizes(program)
        aoti_compile_and_package(program, package_path=str(temporary))
    with zipfile.ZipFile(temporary, "a") as package:
        package.writestr(ARGUMENTS, " ".join(map(str, needed)))
    temporary.replace(path)


def core_graph(program: torch.export.ExportedProgram) -> torch.fx.GraphModule:
    """The program's graph in core ATen operations, in which `stack` is not decomposed."""
    table = torch.export.default_decompositions()
    table.pop(torch.ops.aten.stack.default)
    return program.run_decompositions(table).module(check_guards=False)


def _exported(function: torch.nn.Module, tensors: tuple[Tensor, ...]) -> torch.export.ExportedProgram:
    last = [{tensor.ndim - 1: torch.export.Dim.AUTO} if tensor.ndim and tensor.shape[-1] > 1 else None for tensor in tensors]
    return torch.export.export(function, tensors, dynamic_shapes=(tuple(last),), strict=False)


class _ByRows(torch.nn.Module):
    """A graph with `count` inputs that runs row by row (see `rows.py`), as a function of the inputs with the numbers `needed`."""

    def __init__(self, graph: torch.fx.GraphModule, needed: list[int], count: int):
        super().__init__()
        self._graph, self._needed, self._count = graph, needed, count

    def forward(self, *tensors: Tensor) -> list[Tensor]:
        given = dict(zip(self._needed, tensors))
        return ByRows(self._graph).run(*(given.get(number) for number in range(self._count)))


@contextlib.contextmanager
def _searched_first(folder: Path) -> Iterator[None]:
    """A context in which the C++ compiler searches the given folder for headers before its own folders."""
    before = os.environ.get("CPLUS_INCLUDE_PATH")
    os.environ["CPLUS_INCLUDE_PATH"] = f"{folder}{os.pathsep}{before}" if before else str(folder)
    try:
        yield
    finally:
        del os.environ["CPLUS_INCLUDE_PATH"]
        if before is not None:
            os.environ["CPLUS_INCLUDE_PATH"] = before


@contextlib.contextmanager
def _bits_in_registers() -> Iterator[None]:
    """A context in which Inductor reinterprets float vectors as integers in registers, not element by element on the stack."""
    from torch._inductor.codegen.cpp import CppVecOverrides
    from torch._inductor.virtualized import V

    def to_dtype_bitcast(x: object, dtype: torch.dtype, src_dtype: torch.dtype) -> str:
        return f"c10::bit_cast<{V.kernel._get_vec_type(dtype)}>({x})"  # pyright: ignore[reportAttributeAccessIssue]

    before = CppVecOverrides.to_dtype_bitcast
    CppVecOverrides.to_dtype_bitcast = staticmethod(to_dtype_bitcast)
    try:
        yield
    finally:
        CppVecOverrides.to_dtype_bitcast = staticmethod(before)


def _check_sizes(program: torch.export.ExportedProgram) -> None:
    """Raises RuntimeError if the code contains a size as a constant, because results at other sizes would be wrong."""
    from torch.fx.experimental.symbolic_shapes import is_concrete_int

    arguments = (node.meta["val"] for node in program.graph.nodes if node.op == "placeholder")
    fixed = [int(value.shape[-1]) for value in arguments if value.ndim and is_concrete_int(value.shape[-1])]
    if max(fixed, default=0) > LARGEST_FIXED:
        raise RuntimeError(f"its code depends on the size {max(fixed)} of an argument")
