"""How the process gets its memory."""

from __future__ import annotations

import contextlib
import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8
"""Parameters of glibc's `mallopt`."""
LARGEST = 32 << 20
"""Blocks up to this size, the most that glibc allows, are taken from what was freed before."""
NEVER = 2**31 - 1


def keep_freed_memory() -> None:
    """Let the C library keep memory that batches free for those that come after them, and for other threads'.

    glibc would give it back, and the system clear each of its pages again for the next batch. Other libraries stay as they are.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in ((TRIM_THRESHOLD, NEVER), (MMAP_THRESHOLD, LARGEST), (ARENA_MAX, 1)):
            mallopt(parameter, value)
