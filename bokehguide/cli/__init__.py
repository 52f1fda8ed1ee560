"""The command `bokehguide`."""

from __future__ import annotations

import gc
import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

from bokehguide.stopping import note_at_stop, stop_at_signals, stop_messages

USER_ERROR, INTERRUPTED, PIPE_CLOSED = 2, 130, 141
SETTINGS = ("crop", "device", "light_groups", "reuse_radius", "target_noise")
"""Fields of `RenderSettings` that the parser does not check wholly. Each is an option as well."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code. None: the process is the command, with the arguments of the process.

    0: success; 2: a mistake of the user; 130 or 143: interrupted by SIGINT or SIGTERM; 141: the reader of the output closed the
    pipe.
    """
    if arguments is None:
        _replace_closed_streams()  # before a file or a pipe takes the number of one
        stop_at_signals()  # before any import that takes time
    try:
        try:
            return _run(sys.argv[1:] if arguments is None else arguments, arguments is None)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        discard_lost_output()
        return PIPE_CLOSED
    except OSError as error:  # from stdout alone: all other files have their own messages
        discard_lost_output()
        print(f"bokehguide: error: the output cannot be written ({error.strerror})", file=sys.stderr)
        return USER_ERROR


def _replace_closed_streams() -> None:
    """Let stdout and stderr lead nowhere where the caller has closed them."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            setattr(sys, name, open(number, "w"))  # noqa: PTH123, SIM115, as it stays open to the end


def discard_lost_output() -> None:
    """Let stdout and stderr lead nowhere where they cannot be written: Python flushes them at exit, which must not fail."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _with_option(message: str) -> str:
    """A message that begins with the name of an override or a setting, with the option of the command line in its place."""
    from bokehguide.scene.tables import of_command_line

    name, colon, problem = message.partition(":")
    return f"--{name.replace('_', '-')}{colon}{problem}" if name in SETTINGS else of_command_line(message)


def _run(arguments: Sequence[str], own_process: bool) -> int:
    from bokehguide.cli import terminal
    from bokehguide.cli.arguments import parse
    from bokehguide.cli.memory import explained
    from bokehguide.errors import BokehguideError

    note_at_stop("")  # that of an earlier command of the process
    if own_process:
        terminal.open_streams()
    try:
        options = parse(arguments)
        if own_process:
            terminal.show_log(stages=options.command in ("render", "compare", "view"))
        # Imported by name, so that --help and a mistyped option do not wait for torch.
        with explained("the image" if options.command == "metrics" else "the scene"):
            return _module(options.command, own_process).run(options)
    except BokehguideError as error:
        terminal.say(f"error: {_with_option(str(error))}")
        return USER_ERROR
    except KeyboardInterrupt:  # between two steps, or in a process of which the command is a part
        for message in stop_messages():
            terminal.say(message)
        return INTERRUPTED


def _module(command: str, own_process: bool) -> ModuleType:
    """The module of a command.

    Its imports make 175,000 objects that stay. In a process of its own, the garbage collector leaves them alone: it would look
    at all of them again and again.
    """
    if not own_process:
        return importlib.import_module(f"bokehguide.cli.{command}")
    gc.disable()
    try:
        return importlib.import_module(f"bokehguide.cli.{command}")
    finally:
        gc.freeze()
        gc.enable()
