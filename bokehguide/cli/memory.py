"""Memory that runs out, in one line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from bokehguide.errors import BokehguideError, reason

EXHAUSTED = ("allocate memory", "out of memory", "bad_alloc", "start new thread")
"""Parts of the messages of PyTorch, C++ and Python where memory has run out."""


@contextmanager
def explained(what: str = "the scene") -> Iterator[None]:
    """Turn an error of memory that has run out into a BokehguideError. what: the part of the input that took it."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not any(words in str(error) for words in EXHAUSTED):
            raise
        raise BokehguideError(
            f"memory ran out ({_amount(error)}): {what} is too large for this machine; lower --size or --threads, "
            "or give fewer triangles and smaller textures"
        ) from error


def _amount(error: Exception) -> str:
    """The memory that was refused, in words."""
    asked = re.search(r"allocate (\d+) bytes", str(error))
    return f"{int(asked[1]) / 1e9:.2g} GB more were needed" if asked else reason(error)
