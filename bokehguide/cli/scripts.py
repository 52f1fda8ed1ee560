"""Start and end of the scripts."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from bokehguide.cli import INTERRUPTED, PIPE_CLOSED, USER_ERROR, discard_lost_output
from bokehguide.errors import BokehguideError
from bokehguide.runtime.process import dedicate_process


def run(main: Callable[[], int | None], kept: str = "") -> NoReturn:
    """Call a script's `main` and exit with its return value.

    A BokehguideError becomes one line on stderr and the exit code 2, Ctrl-C one line and 130. Where the reader of the output has
    closed the pipe, the exit code is 141. kept: a note on the files that remain after Ctrl-C.
    """
    name = Path(sys.argv[0]).stem
    dedicate_process()
    try:
        code = main()
        sys.stdout.flush()
        sys.exit(code)
    except BrokenPipeError:
        discard_lost_output()
        sys.exit(PIPE_CLOSED)
    except BokehguideError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    except KeyboardInterrupt:
        print(f"{name}: interrupted{kept and f'; {kept}'}", file=sys.stderr)
        sys.exit(INTERRUPTED)
