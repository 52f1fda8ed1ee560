"""The memory that this process may still take."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from bokehguide.errors import BokehguideError

UNNOTICED = 2**26
"""Bytes that are taken without a look at the free memory, which takes some 50 µs."""


def free_memory(root: Path = Path("/")) -> int | None:
    """Bytes of memory that are free for this process: of the machine, of its control group and within its own limit.

    None where the system does not tell, as on macOS. root: of the file system with `proc` and `sys`.
    """
    free = []
    with suppress(OSError, ValueError):
        free.append(1024 * _number(root / "proc/meminfo", r"MemAvailable:\s+(\d+) kB"))
    group = root / "sys/fs/cgroup"
    with suppress(OSError, ValueError):  # also where the group has no limit
        taken = _number(group / "memory.current", r"(\d+)") - _cached(group / "memory.stat")
        free.append(_number(group / "memory.max", r"(\d+)") - taken)
    with suppress(ImportError, OSError, ValueError):
        import resource  # which Unix alone has

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            free.append(limit - 1024 * _number(root / "proc/self/status", r"VmSize:\s+(\d+) kB"))
    return max(min(free), 0) if free else None


def require_memory(needed: int, place: str, smaller: str) -> None:
    """Raise BokehguideError, naming `place`, if less than `needed` bytes are free. smaller: the remedy, as in "smaller image"."""
    free = free_memory() if needed > UNNOTICED else None
    if free is not None and needed > free:
        raise BokehguideError(
            f"{place}: takes about {needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are free; give a {smaller}"
        )


def _cached(path: Path) -> int:
    """Bytes of files that a control group holds in memory until others need it; 0 where the system does not tell."""
    with suppress(OSError):
        return sum(map(int, re.findall(r"^(?:in)?active_file (\d+)$", path.read_text(), re.MULTILINE)))
    return 0


def _number(path: Path, pattern: str) -> int:
    """The number that a pattern finds in a file. Raises OSError or ValueError where there is none."""
    (found,) = re.findall(pattern, path.read_text())
    return int(found)
