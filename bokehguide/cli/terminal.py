"""What the process of a command does with its terminal: characters, stages before the first step, full disks."""

from __future__ import annotations

import codecs
import errno
import io
import logging
import os
import shutil
import sys

from bokehguide.runtime.bars import on_terminal

PLAIN = {"×": "x", "°": " deg", "…": "...", "²": "^2", "³": "^3", "β": "beta", "→": "->", "–": "-", "’": "'"}
"""Characters of messages, and their form in encodings that lack them."""


def plain_characters(error: UnicodeError) -> tuple[str, int]:
    """An error handler of encoders: characters as in PLAIN, others with backslashes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lost = error.object[error.start : error.end]
    text = "".join(PLAIN.get(mark) or mark.encode("ascii", "backslashreplace").decode() for mark in lost)
    return text, error.end


class _Lenient(io.FileIO):
    """A file whose text is lost where the disk is full, without an error."""

    def write(self, data) -> int:
        """Write bytes; returns their number."""
        try:
            return super().write(data) or 0
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise
            return len(data)


def open_streams() -> None:
    """Let stdout and stderr take every character, and stderr a full disk: a message must not end a render."""
    codecs.register_error("bokehguide", plain_characters)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="bokehguide", line_buffering=True)  # an end by a signal loses no line
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr.flush()
        raw = _Lenient(sys.stderr.fileno(), "w", closefd=False)
        sys.stderr = io.TextIOWrapper(
            io.BufferedWriter(raw), sys.stderr.encoding, "bokehguide", line_buffering=True, write_through=True
        )


class Stages(logging.Handler):
    """Shows the log of the package on stderr: a line for each stage in a file, one line that changes in a terminal.

    Warnings stay in the terminal.
    """

    shown = False
    """Whether the terminal shows a stage."""

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record."""
        text = record.getMessage()
        if record.levelno >= logging.WARNING:
            say(f"warning: {text}")
        elif on_terminal():
            width = shutil.get_terminal_size().columns - 1
            print(f"\r\x1b[K{f'bokehguide: {text} …'[:width]}", end="", file=sys.stderr, flush=True)
            Stages.shown = True
        elif "tqdm" in sys.modules:  # a bar may stand in the last line
            say(text)
        else:
            print(f"bokehguide: {text}", file=sys.stderr, flush=True)


def show_log(stages: bool) -> None:
    """Show the warnings in the log of this command on stderr, and its stages if `stages` is set. Of several ranks, the first
    does."""
    log, first = logging.getLogger("bokehguide"), os.environ.get("RANK", "0") == "0"
    log.addHandler(Stages() if first else logging.NullHandler())
    if first and stages:
        log.setLevel(logging.INFO)
        log.info("starting")


def clear_stage() -> None:
    """Clear the stage that the terminal shows."""
    if Stages.shown:
        Stages.shown = False
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def say(text: str) -> None:
    """Print a line on stderr, above a progress bar."""
    from tqdm import tqdm  # here, as --help does not need it

    clear_stage()
    tqdm.write(f"bokehguide: {text}", sys.stderr)
