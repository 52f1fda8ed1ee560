"""What a scene holds, as a digest that a file can hold."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass

import numpy as np


def digest(value: object) -> str:
    """SHA-256, in hexadecimal, of plain data."""
    found = hashlib.sha256()
    for part in contents(value):
        found.update(part)
    return found.hexdigest()


def contents(value: object) -> Iterator[bytes]:
    """The bytes of plain scene data. A field that has its default is left out: a new one changes no old digest."""
    if is_dataclass(value):
        yield type(value).__name__.encode()
        for field in fields(value):
            part = getattr(value, field.name)
            if isinstance(part, np.ndarray) or part != field.default:
                yield field.name.encode()
                yield from contents(part)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, tuple):
        yield f"tuple of {len(value)}".encode()
        for part in value:
            yield from contents(part)
    else:
        yield repr(value).encode()
