"""SHA-256 digests of plain scene data."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass

import numpy as np

from bokehguide.scene.types import LABEL


def digest(value: object) -> str:
    """The SHA-256 of plain data, in hexadecimal."""
    sha = hashlib.sha256()
    for part in contents(value):
        sha.update(part)
    return sha.hexdigest()


def contents(value: object) -> Iterator[bytes]:
    """The bytes of plain data, without labels. Fields with their default are omitted, so that new fields keep old digests."""
    if is_dataclass(value):
        yield type(value).__name__.encode()
        for field in fields(value):
            part = getattr(value, field.name)
            if LABEL in field.metadata:
                continue
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
