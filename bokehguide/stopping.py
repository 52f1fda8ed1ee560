"""The end of a command by Ctrl-C or SIGTERM outside its steps: at once, whatever the process is doing.

`KeyboardInterrupt` is not enough: it is lost where it is raised in a destructor or in a callback of another library, and code
in C delays it. Imports nothing heavy, so that the command line can begin with it.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

NUMBERS = (signal.SIGINT, signal.SIGTERM)


class _Command:
    """State of the process of a command.

    note: a text for the user at the end by a signal; temporary: files to remove then; watched: whether a thread may end the
    process; ending: held by the thread that does.
    """

    def __init__(self) -> None:
        self.note = ""
        self.temporary: set[str] = set()
        self.watched = False
        self.ending = threading.Lock()


_command = _Command()


def stop_at_signals() -> None:
    """From now on the first SIGINT or SIGTERM ends the process with the exit code 130 or 143. Programs call it at their start.

    Python runs handlers in the main thread, between two of its instructions. While code in C keeps that thread busy, another
    thread ends the process.
    """
    for number in NUMBERS:
        signal.signal(number, _stop)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    _command.watched = True
    threading.Thread(target=_watch, args=(reader,), name="signals", daemon=True).start()


def leave_signals_to_handlers() -> None:
    """From now on handlers alone decide what a signal does: no other thread ends the process."""
    if _command.watched:
        _command.watched = False
        signal.set_wakeup_fd(-1)


def note_at_stop(text: str) -> None:
    """Print `text` when a signal ends the process."""
    _command.note = text


def stop_messages() -> list[str]:
    """Messages about the end by a signal: the note, if there is one, and the end itself."""
    return [message for message in (_command.note, "interrupted") if message]


@contextmanager
def removed_at_stop(path: str | os.PathLike[str]) -> Iterator[None]:
    """A context during which `path` is a temporary file, which an end by a signal removes."""
    _command.temporary.add(os.fspath(path))
    try:
        yield
    finally:
        _command.temporary.discard(os.fspath(path))


@contextmanager
def default_signals() -> Iterator[None]:
    """A context for long work in C that holds the interpreter's lock: the system itself ends the process at a signal.

    A shell reports the same exit codes, 130 and 143. The context does nothing outside the main thread, and where another handler
    than that of `stop_at_signals` is in place.
    """
    main = threading.current_thread() is threading.main_thread()
    mine = [number for number in NUMBERS if main and signal.getsignal(number) is _stop]
    try:
        for number in mine:
            signal.signal(number, signal.SIG_DFL)
        yield
    finally:
        for number in mine:
            signal.signal(number, _stop)


def _watch(reader: int) -> None:
    """End the process at a signal that arrives while the main thread is busy. reader: of the pipe that signals write to."""
    while True:
        number = os.read(reader, 1)[0]
        if _command.watched and number in NUMBERS and signal.getsignal(number) is _stop:
            _stop(number)


def _stop(number: int, _: object = None) -> None:
    """End the process. A second call, from the other thread or for a second signal, leaves the end to the first one."""
    if not _command.ending.acquire(blocking=False):
        return
    for path in tuple(_command.temporary):
        with suppress(OSError):
            os.unlink(path)  # noqa: PTH108, as pathlib takes long to import
    start = "\r\x1b[K" if os.isatty(2) else ""
    with suppress(OSError):
        lines = "".join(f"bokehguide: {message}\n" for message in stop_messages())
        os.write(2, f"{start}{lines}".encode())  # sys.stderr may be in use
    os._exit(128 + number)
