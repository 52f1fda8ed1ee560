"""Files that are either the old ones or the new ones, never half of one."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bokehguide.errors import BokehguideError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that takes its place once all is written.

    Where the block fails, `path` is left as it was. Raises BokehguideError where
    the folder cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        with temporary.open("rb") as written:
            os.fsync(written.fileno())  # or a power cut could leave the new name with nothing behind it
        os.replace(temporary, path)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def check_writable(path: str | Path) -> None:
    """Make the folder of the file `path` where it is missing, and try to write there.

    A trial is the only test that also sees full disks and read-only mounts.
    Raises BokehguideError where it fails or where `path` is itself a folder.
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
    """Remove what processes that were killed while they wrote the file `path` have left beside it."""
    path = Path(path)
    for temporary in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        writer = temporary.suffixes[-2].removeprefix(".")
        if writer.isdecimal() and not _runs(int(writer)):
            with suppress(OSError):
                temporary.unlink()


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def unwritable(path: Path, error: Exception) -> BokehguideError:
    reason = getattr(error, "strerror", None) or error
    return BokehguideError(f"{path}: cannot be written ({reason}); choose another folder")
