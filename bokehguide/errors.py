"""The one exception a user's mistake raises, and how a part of it is told in one line."""


class BokehguideError(Exception):
    """A mistake in what the user gave: a file, a field, a value.

    The message is one or two lines that name the file, the field, the value and
    the remedy. The command line prints it without a traceback and exits with 2.
    """


def reason(error: Exception) -> str:
    """What another library says is wrong: the first line of it, as far as it can be printed, or the exception's name."""
    lines = str(error).splitlines()
    return printable(lines[0], 200) if lines and lines[0].strip() else type(error).__name__


def printable(text: str, longest: int = 60) -> str:
    """`text` of a file for people: one line without control characters, cut where it is long."""
    line = " ".join("".join(mark if mark.isprintable() else " " for mark in text[: 4 * longest]).split())
    return line if len(line) <= longest else f"{line[:longest]}…"
