"""Messages to the user."""

from __future__ import annotations


class RenderError(Exception):
    """A mistake that ends a render; its text tells the remedy."""


def listed(names: list[str], most: int = 3) -> str:
    """Some names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


class Cancelled(Exception):
    """The user has ended the render."""
