"""The memory that this process may still take."""

from __future__ import annotations

import re
import resource
from contextlib import suppress
from pathlib import Path


def free_memory(root: Path = Path("/")) -> int | None:
    """Bytes of memory that are free for this process: of the machine, of its control group and within its own limit.

    None where the system does not tell, as on macOS. root: of the file system with `proc` and `sys`.
    """
    free = []
    with suppress(OSError, ValueError):
        free.append(1024 * _number(root / "proc/meminfo", r"MemAvailable:\s+(\d+) kB"))
    group = root / "sys/fs/cgroup"
    with suppress(OSError, ValueError):  # also where the group has no limit
        free.append(_number(group / "memory.max", r"(\d+)") - _number(group / "memory.current", r"(\d+)"))
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    with suppress(OSError, ValueError):
        if limit != resource.RLIM_INFINITY:
            free.append(limit - 1024 * _number(root / "proc/self/status", r"VmSize:\s+(\d+) kB"))
    return max(min(free), 0) if free else None


def _number(path: Path, pattern: str) -> int:
    """The number that a pattern finds in a file. Raises OSError or ValueError where there is none."""
    (found,) = re.findall(pattern, path.read_text())
    return int(found)
