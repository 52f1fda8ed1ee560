"""What a reader of another format leaves out, as warnings."""

from __future__ import annotations

from itertools import islice

from bokehguide.errors import printable

SHOWN = 4
"""Names in a warning."""
UNKNOWN_NAMES = "parameters of an unknown name: ignored"
"""The loss of parameters that `unknown_name` describes."""


class Losses:
    """What a reader leaves out, in words, each with the names of its objects in the order of their first mention."""

    def __init__(self) -> None:
        self._names: dict[str, dict[str, None]] = {}

    def __contains__(self, what: str) -> bool:
        return what in self._names

    def add(self, what: str, name: str = "") -> None:
        """Note a loss of an object, "" for none."""
        names = self._names.setdefault(what, {})
        if name:
            names[name] = None

    def lines(self, file: str = "", end: str = "") -> list[str]:
        """One line for each loss that ends with `end`, with the first names of its objects. file: stands before each line."""
        lines = []
        for loss, names in self._names.items():
            if loss.endswith(end):
                shown = f" ({', '.join(islice(names, SHOWN))}{', …' if len(names) > SHOWN else ''})" if names else ""
                lines.append(printable(f"{file}: {loss}{shown}" if file else f"{loss}{shown}", 400))
        return lines


def unknown_name(place: str, key: str, near: str) -> str:
    """The parameter `key` at `place`, which may stand for the known name `near`, empty for none."""
    return f"{place}: {printable(key)}" + (f"; did you mean {near}?" if near else "")
