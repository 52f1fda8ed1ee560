"""Messages of the USD libraries in errors."""

from __future__ import annotations

from pathlib import Path

from bokehguide.errors import printable, reason


def problem_of(error: Exception, path: Path) -> str:
    """The message of an exception of USD, without the place in its source. path: of the stage, named without its folder."""
    try:
        text = str(error).strip().partition(" : ")[2].replace(str(path), path.name)
        text = text.strip().removeprefix("'").removesuffix("'")
        if "bad_alloc" in text:
            return "it is damaged, or too large"
        return printable(text, 200) or reason(error)
    except UnicodeDecodeError:  # USD quotes the file
        return "text that is no UTF-8"
