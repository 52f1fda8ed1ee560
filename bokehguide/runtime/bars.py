"""Progress bars, also in terminals that report no size."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm

COLUMNS, ROWS = 80, 24
"""Size of a terminal that reports none."""


def progress(title: str, total: int, done: int = 0, unit: str = "SPP") -> tqdm:
    """A progress bar; a terminal gets a moving bar, a log file a line every 30 seconds, a process without stderr none."""
    from tqdm import tqdm  # here, as --help does not need it

    options = {"mininterval": 0.1 if on_terminal() else 30.0, "disable": sys.stderr is None, **terminal_size()}
    return tqdm(total=total, initial=min(done, total), desc=title, unit=unit, **options)


def on_terminal() -> bool:
    """Whether stderr is a terminal. A process without a console may have no stderr."""
    return sys.stderr is not None and not sys.stderr.closed and sys.stderr.isatty()


def terminal_size() -> dict[str, Any]:
    """The arguments of tqdm for the size of the terminal, which tqdm asks for itself unless the terminal reports 0."""
    unknown = on_terminal() and 0 in os.get_terminal_size(sys.stderr.fileno())
    return {"ncols": COLUMNS, "nrows": ROWS} if unknown else {"dynamic_ncols": True}
