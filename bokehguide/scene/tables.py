"""A table of a scene file, every key of it checked, with errors that name the place."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NoReturn

from bokehguide.errors import BokehguideError


@dataclass(frozen=True)
class Limits:
    """Which finite numbers a field accepts: an interval and how to say it."""

    remedy: str
    low: float = -math.inf
    high: float = math.inf
    open: bool = False

    def hold(self, value: float) -> bool:
        inside = self.low < value < self.high if self.open else self.low <= value <= self.high
        return inside and math.isfinite(value)


ANY = Limits("a finite number")
POSITIVE = Limits("a number above 0", low=0.0, open=True)
IN_FRONT = Limits("metres above 0: what lies behind the lens has no focus", low=0.0, open=True)
NOT_NEGATIVE = Limits("a number of 0 or more", low=0.0)
SHARE = Limits("a number between 0 and 1", low=0.0, high=1.0)
ANGLE_OF_VIEW = Limits("degrees between 0 and 180", low=0.0, high=180.0, open=True)
IOR = Limits("a number of 1 or more", low=1.0)
COUNT = Limits("a whole number of 1 or more", low=1.0)


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A hint at the nearest of `known`, or all of them."""
    known = list(known)
    near = difflib.get_close_matches(word, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"


class Table:
    """Typed reading of `values`, the table at `path` of `file`.

    Each reader gives `default` for an absent key and raises BokehguideError naming
    file, field, value and remedy for a wrong one.
    """

    def __init__(self, values: Any, file: str, path: str, keys: Iterable[str]):
        self.file, self.path, self.values = file, path, values
        if not isinstance(values, dict):
            raise BokehguideError(f"{file}: {path}: {values!r} is not a table; write [{path}]")
        for key in values:
            if key not in keys:
                raise BokehguideError(f"{self.place(key)}: unknown key; {did_you_mean(key, keys)}")

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def place(self, key: str) -> str:
        """Where `key` stands, as in `scene.toml: camera.fov`."""
        return f"{self.file}: {self.path}.{key}" if self.path else f"{self.file}: {key}"

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise the error that the value of `key` has `problem`."""
        raise BokehguideError(f"{self.place(key)}: {self.values[key]!r} {problem}")

    def exclusive(self, *keys: str) -> None:
        """Raise unless at most one of `keys` is there."""
        given = [key for key in keys if key in self]
        if len(given) > 1:
            first, second = given[:2]
            self.fail(first, f"and {second} = {self.values[second]!r} are both given; keep one")

    def number(self, key: str, default: float | None, limits: Limits = ANY) -> float | None:
        """A finite number within `limits`."""
        if key not in self:
            return default
        value = self.values[key]
        if not is_number(value):
            self.fail(key, f"is not a number; give {limits.remedy}")
        if not limits.hold(value):
            self.fail(key, f"is out of range; give {limits.remedy}")
        return float(value)

    def count(self, key: str, default: int) -> int:
        """A whole number of 1 or more."""
        if key in self and not (type(self.values[key]) is int and COUNT.hold(self.values[key])):
            self.fail(key, f"is out of range; give {COUNT.remedy}")
        return self.values.get(key, default)

    def vector(self, key: str, default: tuple | None, limits: Limits = ANY) -> tuple | None:
        """Three numbers, each within `limits`."""
        if key not in self:
            return default
        value = self.values[key]
        if not (isinstance(value, (list, tuple)) and len(value) == 3 and all(map(is_number, value))):
            self.fail(key, f"is not three numbers; give [x, y, z], each {limits.remedy}")
        if not all(map(limits.hold, value)):
            self.fail(key, f"is out of range; give three values, each {limits.remedy}")
        return tuple(float(component) for component in value)

    def text(self, key: str) -> str | None:
        """A string that is not empty, or None."""
        if key in self and not (isinstance(self.values[key], str) and self.values[key]):
            self.fail(key, 'is not a text; write it in quotes, as in "name"')
        return self.values.get(key)

    def flag(self, key: str) -> bool:
        """True or false, false where absent."""
        if key in self and not isinstance(self.values[key], bool):
            self.fail(key, "is neither true nor false; give one of them")
        return self.values.get(key, False)
