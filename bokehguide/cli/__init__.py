"""The command `bokehguide`."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from bokehguide.cli.arguments import parse
from bokehguide.errors import BokehguideError

SUCCESS, USER_ERROR, INTERRUPTED = 0, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 (the user's mistake) or 130 (interrupted)."""
    try:
        options = parse(sys.argv[1:] if arguments is None else arguments)
        # Loaded by name so that --help and a mistyped option need not wait for torch.
        command = importlib.import_module(f"bokehguide.cli.{options.command}")
        return command.run(options)
    except BokehguideError as error:
        print(f"bokehguide: error: {error}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print("bokehguide: interrupted", file=sys.stderr)
        return INTERRUPTED
