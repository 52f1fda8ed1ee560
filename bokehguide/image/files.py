"""Atomic replacement of files."""

from __future__ import annotations

import errno
import glob
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bokehguide.errors import BokehguideError, printable
from bokehguide.stopping import removed_at_stop

REMEDIES = {
    os.strerror(errno.ENOENT): "create the folder, or choose another",
    os.strerror(errno.ENAMETOOLONG): "choose a shorter name",
    os.strerror(errno.ENOSPC): "free some space, or choose another folder",
    os.strerror(errno.EDQUOT): "free some space, or choose another folder",
}
"""Remedies for a file that cannot be written, by the cause as the system words it."""


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` at the end of the block. A symbolic link stays, and its target is replaced.

    If the block fails, `path` does not change. Raises BokehguideError if the folder cannot be written.
    """
    path, target = Path(path), written_file(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    with removed_at_stop(temporary):
        try:
            yield temporary
            with temporary.open("rb") as written:
                os.fsync(written.fileno())  # otherwise a power failure could leave an empty file under the new name
            temporary.replace(target)
        except OSError as error:
            raise unwritable(path, error) from error
        finally:
            with suppress(OSError):
                temporary.unlink()


def write_text(path: str | Path, text: str) -> None:
    """Replace the file `path` by a text in UTF-8. Raises BokehguideError as `replacing`."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def written_file(path: str | Path) -> Path:
    """The file that a write to `path` replaces: the target of a symbolic link, else `path`."""
    path = Path(path)
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def check_writable(path: str | Path) -> None:
    """Create the folder of the file `path` if it is missing, and write a trial file there.

    Only a trial detects full disks and read-only mounts. Raises BokehguideError if the trial fails, or if `path` is a folder or a
    device.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode if path.exists() else stat.S_IFREG
        if stat.S_ISDIR(mode):
            raise BokehguideError(f"{path}: is a folder; give the path of a file in it")
        if not stat.S_ISREG(mode):
            raise BokehguideError(f"{path}: is no regular file, and would be replaced by one; give another path")
        path.parent.mkdir(parents=True, exist_ok=True)
        target = written_file(path)
        trial = target.with_name(f".{target.name}.{os.getpid()}.tmp")
        with removed_at_stop(trial):
            trial.touch()
            trial.unlink()
    except OSError as error:
        raise unwritable(path, error) from error


def make_folder(path: str | Path) -> bool:
    """Create the folder `path` in an existing one; returns whether it was missing.

    Raises BokehguideError if the folder above does not exist: a mistyped path must not become a tree of folders.
    """
    path = Path(path)
    try:
        if path.exists():
            return False
        if not path.parent.exists():
            raise BokehguideError(f"{path}: the folder {path.parent} does not exist; create it, or choose another folder")
        path.mkdir()
    except OSError as error:
        raise unwritable(path, error) from error
    return True


def remove_abandoned(path: str | Path) -> None:
    """Remove temporary files of `path` that killed processes have left."""
    path = written_file(path)
    for temporary in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        writer = temporary.suffixes[-2].removeprefix(".")
        if writer.isdecimal() and not _runs(int(writer)):
            with suppress(OSError):
                temporary.unlink()


def _runs(process: int) -> bool:
    """Whether a process with this id exists; true on Windows, where the question would end the process."""
    if sys.platform == "win32":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def unwritable(path: Path, error: Exception) -> BokehguideError:
    """The error for a file that cannot be written."""
    # OpenEXR names the temporary file before the cause: `Cannot open image file "PATH". Permission denied.`
    reason = getattr(error, "strerror", None) or str(error).rpartition('". ')[2].rstrip(".")
    remedy = REMEDIES.get(reason, "choose another folder")
    return BokehguideError(f"{printable(str(path), 400)}: cannot be written ({reason}); {remedy}")
