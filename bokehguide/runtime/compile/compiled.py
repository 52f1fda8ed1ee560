"""Calls of compiled packages of AOTInductor through its C interface.

PyTorch's own loader holds the global interpreter lock (GIL) while a kernel runs, so that kernels of several threads would run one
after the other. `ctypes` releases the GIL during the call.
"""

from __future__ import annotations

import ctypes
import tempfile
import zipfile
from pathlib import Path

import torch
from torch import Tensor
from torch._C._aoti import alloc_tensors_by_stealing_from_void_ptrs, unsafe_alloc_void_ptrs_from_tensors

_new_capsule = ctypes.pythonapi.PyCapsule_New
_new_capsule.restype, _new_capsule.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_pointer.restype, _pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]


ARGUMENTS = "arguments.txt"
"""The file in a package that lists the numbers of the tensors that the code uses."""
AS_FLOATS = {torch.int32: torch.float32, torch.int64: torch.float64}
"""Integer types, and the float types of the same size. Kernels get integer tensors as floats of the same bits, because PyTorch's
integer vectors load through the stack, five times as slowly."""


def as_floats(tensor: Tensor) -> Tensor:
    """The tensor, reinterpreted by `AS_FLOATS`."""
    kind = AS_FLOATS.get(tensor.dtype)
    return tensor if kind is None else tensor.view(kind)


class CompiledFunction:
    """A function of tensors in a package of `compiling.py`. `threads` threads can run the function concurrently; further threads
    wait.

    path: of the package. Raises OSError, ValueError, KeyError, zipfile.BadZipFile or RuntimeError for an invalid package.
    """

    def __init__(self, path: Path, threads: int):
        (library, self._arguments), container, outputs = _library(path), ctypes.c_void_p(), ctypes.c_size_t()
        _check(library.AOTInductorModelContainerCreateWithDevice(ctypes.byref(container), ctypes.c_size_t(threads), b"cpu", None))
        _check(library.AOTInductorModelContainerGetNumOutputs(container, ctypes.byref(outputs)))
        self._run, self._container, self._outputs = library.AOTInductorModelContainerRun, container, outputs.value

    def __call__(self, tensors: list[Tensor]) -> list[Tensor]:
        """The results for a list of tensors."""
        tensors = [as_floats(tensors[number].contiguous()) for number in self._arguments]
        given = [_pointer(capsule, None) for capsule in unsafe_alloc_void_ptrs_from_tensors(tensors)]
        inputs, outputs = (ctypes.c_void_p * len(given))(*given), (ctypes.c_void_p * self._outputs)()
        # The library frees the handles of the inputs. Tensors made from the handles of the outputs free the output handles.
        sizes = ctypes.c_size_t(len(given)), ctypes.c_size_t(self._outputs)
        _check(self._run(self._container, inputs, sizes[0], outputs, sizes[1], None, None))
        return alloc_tensors_by_stealing_from_void_ptrs([_new_capsule(handle, None, None) for handle in outputs])


def _check(status: int) -> None:
    if status != 0:
        raise RuntimeError("the compiled code fails")


def _library(path: Path) -> tuple[ctypes.CDLL, list[int]]:
    """The library in a package, and the numbers of the tensors that it uses.

    Raises RuntimeError if the library calls operations that only PyTorch's loader provides.
    """
    with zipfile.ZipFile(path) as package:
        names = package.namelist()
        (library,) = (name for name in names if name.endswith(".so"))
        if any(name.endswith(".json") and not name.endswith("_metadata.json") for name in names):
            raise RuntimeError("it calls operations that are not compiled")
        code, arguments = package.read(library), [int(number) for number in package.read(ARGUMENTS).split()]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "kernel.so"
        file.write_bytes(code)
        return ctypes.CDLL(str(file)), arguments
