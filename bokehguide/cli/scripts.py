"""How the scripts start and end."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from bokehguide.cli import INTERRUPTED, USER_ERROR
from bokehguide.errors import BokehguideError


def run(main: Callable[[], int | None], kept: str = "") -> NoReturn:
    """Call a script's `main` and exit with what it returns.

    A mistake of the user becomes one line and the exit code 2, Ctrl-C a line and 130. kept: what is not lost then.
    """
    name = Path(sys.argv[0]).stem
    try:
        sys.exit(main())
    except BokehguideError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    except KeyboardInterrupt:
        print(f"{name}: interrupted{kept and f'; {kept}'}", file=sys.stderr)
        sys.exit(INTERRUPTED)
