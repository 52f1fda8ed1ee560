"""Progress bars, also in terminals that report no size."""

from __future__ import annotations

import os
import sys
from typing import Any

from tqdm import tqdm

COLUMNS, ROWS = 80, 24
"""Size of a terminal that reports none."""


def progress(title: str, total: int, done: int = 0, unit: str = "SPP") -> tqdm:
    """A progress bar; a terminal gets a moving bar, a log file a line every 30 seconds."""
    interval = 0.1 if sys.stderr.isatty() else 30.0
    return tqdm(total=total, initial=min(done, total), desc=title, unit=unit, mininterval=interval, **terminal_size())


def terminal_size() -> dict[str, Any]:
    """The arguments of tqdm for the size of the terminal, which tqdm asks for itself unless the terminal reports 0."""
    unknown = sys.stderr.isatty() and 0 in os.get_terminal_size(sys.stderr.fileno())
    return {"ncols": COLUMNS, "nrows": ROWS} if unknown else {"dynamic_ncols": True}
