"""Settings of a process that does nothing but render."""

from __future__ import annotations

import contextlib
import ctypes

import torch

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8
"""Parameters of glibc's `mallopt`."""
LARGEST = 32 << 20
"""glibc reuses freed blocks of up to this size in bytes, the largest that `mallopt` accepts."""
NEVER = 2**31 - 1


def dedicate_process() -> None:
    """Use the whole process for rendering: freed memory is kept, and PyTorch uses one OpenMP thread.

    Programs call this function at their start. The first setting cannot be undone.
    """
    torch.set_num_threads(1)
    _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Let glibc keep the memory that batches free, for later batches on any thread.

    By default glibc returns large blocks to the system, which has to clear their pages for the next batch. Other C libraries
    stay as they are.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in ((TRIM_THRESHOLD, NEVER), (MMAP_THRESHOLD, LARGEST), (ARENA_MAX, 1)):
            mallopt(parameter, value)
