"""What a reader of another format leaves out, as warnings."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import islice

from bokehguide.errors import printable

SHOWN = 4
"""Names in a warning."""
UNKNOWN_NAMES = "parameters of an unknown name: ignored"
"""The loss of parameters that `unknown_name` describes."""


def unknown_name(place: str, key: str, near: str) -> str:
    """The parameter `key` at `place`, which may stand for the known name `near`, empty for none."""
    return f"{place}: {printable(key)}" + (f"; did you mean {near}?" if near else "")


def loss_lines(losses: Mapping[str, Collection[str]], file: str = "") -> list[str]:
    """One line for each loss, with the first names of its objects. losses: names by loss; file: stands before each line."""
    lines = []
    for loss, names in losses.items():
        shown = f" ({', '.join(islice(names, SHOWN))}{', …' if len(names) > SHOWN else ''})" if names else ""
        lines.append(printable(f"{file}: {loss}{shown}" if file else f"{loss}{shown}", 400))
    return lines
