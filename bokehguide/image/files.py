"""Atomic replacement of files."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bokehguide.errors import BokehguideError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` at the end of the block.

    If the block fails, `path` does not change. Raises BokehguideError if the folder cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        with temporary.open("rb") as written:
            os.fsync(written.fileno())  # otherwise a power failure could leave an empty file under the new name
        temporary.replace(path)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def check_writable(path: str | Path) -> None:
    """Create the folder of the file `path` if it is missing, and write a trial file there.

    Only a trial detects full disks and read-only mounts. Raises BokehguideError if the trial fails or if `path` is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise BokehguideError(f"{path}: is a folder; give the path of a file in it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        trial = path.with_name(f".{path.name}.{os.getpid()}.trial")
        trial.touch()
        trial.unlink()
    except OSError as error:
        raise unwritable(path, error) from error


def remove_abandoned(path: str | Path) -> None:
    """Remove temporary files of `path` that killed processes have left."""
    path = Path(path)
    for temporary in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        writer = temporary.suffixes[-2].removeprefix(".")
        if writer.isdecimal() and not _runs(int(writer)):
            with suppress(OSError):
                temporary.unlink()


def _runs(process: int) -> bool:
    """Whether a process with this id exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def unwritable(path: Path, error: Exception) -> BokehguideError:
    """The error for a file that cannot be written."""
    reason = getattr(error, "strerror", None) or error
    return BokehguideError(f"{path}: cannot be written ({reason}); choose another folder")
