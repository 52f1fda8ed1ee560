"""Messages to the user."""

from __future__ import annotations


class RenderError(Exception):
    """A mistake that ends a render; its text tells the remedy."""


def listed(names: list[str], most: int = 3) -> str:
    """Some names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


class Losses:
    """Losses of a scene by their text, each with the names of the parts that have it."""

    def __init__(self) -> None:
        self._names: dict[str, dict[str, None]] = {}

    def add(self, text: str, name: str) -> None:
        self._names.setdefault(text, {})[name] = None

    def lines(self) -> list[str]:
        """One warning for each text, with some of the names."""
        return [f"{text}: {listed(list(names))}" for text, names in self._names.items()]


class Cancelled(Exception):
    """The user has ended the render."""
