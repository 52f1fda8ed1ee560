"""The lock that keeps two renders from writing the same files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from bokehguide.errors import BokehguideError
from bokehguide.image.files import written_file
from bokehguide.stopping import removed_at_stop


@contextmanager
def sole_writer(out: Path) -> Iterator[None]:
    """Lock `out` and the files beside it during the block. The system unlocks them at the end of the process, however it ends.

    Raises BokehguideError if another render has the lock. A system or a file system without such locks refuses no render.
    """
    target = written_file(out)
    path = target.with_name(f".{target.stem}.lock")
    try:
        file = _locked(path)
    except BlockingIOError:
        raise BokehguideError(f"{out}: another render is writing this file; wait for its end, or give another --out") from None
    except (ImportError, OSError):
        file = None
    if file is None:
        yield
        return
    with removed_at_stop(path), file:
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()  # before the unlock, so that no other render locks a file that this one removes


def _locked(path: Path) -> IO[str]:
    """The file at `path`, locked. Raises BlockingIOError if another process has it, and OSError or ImportError without locks."""
    import fcntl  # which Windows lacks

    while True:
        file = path.open("a")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except FileNotFoundError:
            pass
        except OSError:
            file.close()
            raise
        file.close()  # its owner removed it between the opening and the lock
