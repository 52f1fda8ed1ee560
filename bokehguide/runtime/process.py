"""Settings of a process whose only task is a render."""

from __future__ import annotations

import contextlib
import ctypes

import torch

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8
"""Parameters of glibc's `mallopt`."""
LARGEST = 32 << 20
"""Largest size in bytes of freed blocks that glibc reuses: the largest value that `mallopt` accepts."""
NEVER = 2**31 - 1


def dedicate_process() -> None:
    """Use the whole process for rendering: the process keeps freed memory, and PyTorch uses one OpenMP thread.

    Call this function at the start of a program. The memory setting cannot be undone.
    """
    torch.set_num_threads(1)
    _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Let glibc keep the memory that batches free, for later batches on any thread.

    By default, glibc returns large blocks to the system, and the system must clear their pages for the next batch. The function
    has no effect on other C libraries.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in ((TRIM_THRESHOLD, NEVER), (MMAP_THRESHOLD, LARGEST), (ARENA_MAX, 1)):
            mallopt(parameter, value)


def return_freed_memory() -> None:
    """Return freed memory to the system, for programs that rest between pictures of different sizes.

    The function has no effect on other C libraries than glibc.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
