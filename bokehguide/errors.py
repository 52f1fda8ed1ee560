"""The exception for a mistake of the user, and one-line texts for its message."""

import sys


class BokehguideError(Exception):
    """A mistake in the user's input: a file, a field, a value.

    The message names the file, the field, the value and the remedy in one or two lines. The command line prints it without a
    traceback and exits with code 2.
    """


def reason(error: Exception) -> str:
    """The first line of another library's error message in printable form, or the name of the exception."""
    lines = str(error).splitlines()
    return printable(lines[0], 200) if lines and lines[0].strip() else type(error).__name__


def printable(text: str, longest: int = 60) -> str:
    """`text` as one line without control characters, of at most `longest` characters and an ellipsis."""
    line = " ".join("".join(mark if mark.isprintable() else " " for mark in text[: 4 * longest]).split())
    return line if len(line) <= longest else f"{line[:longest]}…"


def encoding_problem(name: str) -> str:
    """Why a file of this name cannot be opened, and the remedy; empty for a name that can be opened.

    Image libraries take names as UTF-8, and Python takes names in the encoding of the environment.
    """
    if name.isascii():
        return ""
    if sys.getfilesystemencoding() != "utf-8":
        return "needs file names in UTF-8, which this environment lacks; set PYTHONUTF8=1"
    try:
        name.encode()
    except UnicodeEncodeError:
        return "is no UTF-8 text; rename the file or folder"
    return ""
