"""The native core: the extension `bokehguide._native` on the Embree library that embreex brings.

Its sources lie in `native/`. Where it is not built, or Embree does not fit, PyTorch and embreex do the same work more slowly. The
environment variable `BOKEHGUIDE_NATIVE=0` chooses them everywhere.
"""

from __future__ import annotations

import functools
import importlib
import os
from pathlib import Path
from types import ModuleType

import embreex
import torch

SWITCH = "BOKEHGUIDE_NATIVE"
"""The environment variable that switches the native core off."""
VERSIONS = range(40400, 50000)
"""Versions of Embree whose interface `native/embree.h` declares."""
_PATTERNS = ("../embreex.libs/*embree4*", ".dylibs/*embree4*", "*embree4*")
"""Places of the library beside the package, as auditwheel, delvewheel and delocate put it."""


def core() -> ModuleType | None:
    """The extension, None where it is missing or switched off."""
    return None if os.environ.get(SWITCH) == "0" else _loaded()


def core_on(device: torch.device) -> ModuleType | None:
    """As `core` for tensors of a CPU; None for tensors of another device."""
    return core() if device.type == "cpu" else None


@functools.cache
def _loaded() -> ModuleType | None:
    try:
        extension = importlib.import_module("bokehguide._native")
    except ImportError:
        return None
    for library in embree_libraries():
        try:
            if extension.load_embree(str(library)) in VERSIONS:
                return extension
        except RuntimeError:
            continue
    return None


def embree_libraries() -> list[Path]:
    """Files that may be the Embree library that embreex brings."""
    folder = Path(embreex.__file__).parent
    return [path.resolve() for pattern in _PATTERNS for path in sorted(folder.glob(pattern))]
