"""The command `bokehguide`."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from bokehguide.cli.arguments import parse
from bokehguide.errors import BokehguideError

SUCCESS, USER_ERROR, INTERRUPTED, PIPE_CLOSED = 0, 2, 130, 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    0: success; 2: a mistake of the user; 130: interrupted; 141: the reader of the output closed the pipe.
    """
    try:
        try:
            return _run(sys.argv[1:] if arguments is None else arguments)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes stdout again at exit; that flush must not fail.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED


def _run(arguments: Sequence[str]) -> int:
    try:
        options = parse(arguments)
        # Imported by name, so that --help and a mistyped option do not wait for torch.
        command = importlib.import_module(f"bokehguide.cli.{options.command}")
        return command.run(options)
    except BokehguideError as error:
        print(f"bokehguide: error: {error}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print("bokehguide: interrupted", file=sys.stderr)
        return INTERRUPTED
