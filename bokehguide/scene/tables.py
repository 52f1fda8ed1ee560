"""Checked reading of the tables of a scene file."""

from __future__ import annotations

import difflib
import math
import re
import reprlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NoReturn

from bokehguide.errors import BokehguideError, printable
from bokehguide.limits import LARGEST, MAX_EXPOSURE, MAX_SIDE, NEAREST_FOCUS, SMALLEST
from bokehguide.scene.vectors import Vector, as_vector


@dataclass(frozen=True)
class Limits:
    """The closed interval of numbers that a field accepts, and its description for error messages.

    infinity: also accepts math.inf.
    """

    remedy: str
    low: float = -LARGEST
    high: float = LARGEST
    infinity: bool = False

    def contains(self, value: float) -> bool:
        """True where the field accepts `value`."""
        return self.low <= value <= self.high or (self.infinity and value == math.inf)


ANY = Limits(f"a number between {-LARGEST:g} and {LARGEST:g}")
POSITIVE = Limits(f"a number above 0, between {SMALLEST:g} and {LARGEST:g}", low=SMALLEST)
IN_FRONT = Limits(
    f"metres above 0, between {NEAREST_FOCUS:g} and {LARGEST:g}, or inf; the focal plane is never behind the lens",
    low=NEAREST_FOCUS,
    infinity=True,
)
NOT_NEGATIVE = Limits(f"a number of 0 or more, up to {LARGEST:g}", low=0.0)
FRACTION = Limits("a number between 0 and 1", low=0.0, high=1.0)
SIGNED_FRACTION = Limits("a number between -1 and 1", low=-1.0, high=1.0)
RATIO = Limits("a number between 0.1 and 10", low=0.1, high=10.0)
CAT_EYE = Limits("a number between 0 and 1.5", low=0.0, high=1.5)
ANGLE_OF_VIEW = Limits("degrees between 0 and 180 (from 0.001 to 179.999)", low=1e-3, high=179.999)
EMITTER_RADIUS = Limits("metres from 1e-6 to 1e6", low=1e-6, high=1e6)
SUN_ANGLE = Limits("degrees from 0.01 to 90", low=0.01, high=90.0)
KELVIN = Limits("kelvin from 1000 to 15000", low=1e3, high=15e3)
CONE_ANGLE = Limits("degrees from 0 to 90", low=0.0, high=90.0)
IOR = Limits(f"a number of 1 or more, up to {LARGEST:g}", low=1.0)
FILM = Limits("nanometres from 0 to 100000", low=0.0, high=1e5)
EXPOSURE = Limits(f'EV from {-MAX_EXPOSURE:g} to {MAX_EXPOSURE:g}, or "auto"', low=-MAX_EXPOSURE, high=MAX_EXPOSURE)
COUNT = Limits(f"a whole number of 1 or more, up to {MAX_SIDE}", low=1, high=MAX_SIDE)


LONGEST_LIST = 200
"""Characters of a list of known words in an error."""


class _Short(reprlib.Repr):
    """Values as they were written, shortened to one line."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = 120

    def repr_int(self, x: int, level: int) -> str:
        """`x` in decimal, or its number of bits if it is very long."""
        return repr(x) if x.bit_length() <= 128 else f"a whole number of {x.bit_length()} bits"

    def repr_instance(self, x: object, level: int) -> str:
        """`x` in one line, also where its class writes several, as NumPy does for matrices."""
        return " ".join(super().repr_instance(x, level).split())


shown = _Short().repr


def override_place(key: str) -> str:
    """An override in a message: the field of `Overrides`, and the option of the command line."""
    return f"{key} or --{key.replace('_', '-')}"


def of_command_line(message: str) -> str:
    """A message that begins with an override, with the option alone."""
    return re.sub(r"^\w+ or (?=--[a-z])", "", message)


def in_fractions(box: Iterable[float]) -> bool:
    """Whether a crop is in fractions of the frame, not in pixels."""
    return all(0.0 <= value <= 1.0 for value in box)


def leaves_frame(x: float, y: float, width: float, height: float) -> bool:
    """Whether a box in fractions of the frame is empty or not wholly in the frame."""
    return not (x >= 0 and y >= 0 and width > 0 and height > 0 and x + width <= 1 and y + height <= 1)


def is_number(value: Any) -> bool:
    """True for integers and floats, but not for booleans."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """A hint: the word of `known` that is most similar; all of them if none is, or the nearest three of a long list.

    prefix: before each known word in the hint, but not compared.
    """
    known = list(known)
    near = difflib.get_close_matches(word, known, n=1)
    if near:
        return f"did you mean {shown(prefix + near[0])}?"
    listed = f"known are {', '.join(prefix + each for each in known)}"
    if len(listed) > LONGEST_LIST:
        nearest = ", ".join(prefix + each for each in difflib.get_close_matches(word, known, n=3, cutoff=0.0))
        listed = f"the nearest of {len(known)} known are {nearest}"
    return printable(listed, LONGEST_LIST)


class Table:
    """Typed readers of `values`, the table at `path` of `file`.

    Each reader returns `default` for an absent key. It raises BokehguideError for a wrong
    value, and for an absent key without a default. The message names file, field, value and remedy.
    """

    def __init__(self, values: Any, file: str, path: str, keys: Iterable[str]):
        self.file, self.path, self.values = file, path, values
        if not isinstance(values, dict):
            raise BokehguideError(f"{file}: {printable(path, 120)}: {shown(values)} is not a table; write it as one")
        for key in values:
            if key not in keys:
                raise BokehguideError(f"{self.place(key)}: unknown key; {did_you_mean(key, keys)}")

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def place(self, key: str) -> str:
        """The location of `key`, such as `scene.toml: camera.fov`."""
        return f"{self.file}: {printable(f'{self.path}.{key}' if self.path else str(key), 120)}"

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise the error that the value of `key` has `problem`."""
        raise BokehguideError(f"{self.place(key)}: {shown(self.values[key])} {problem}")

    def missing(self, key: str, remedy: str) -> NoReturn:
        """Raise the error that `key` is absent."""
        raise BokehguideError(f"{self.place(key)}: missing; {remedy}")

    def exclusive(self, *keys: str) -> None:
        """Raise BokehguideError if more than one of `keys` is present."""
        given = [key for key in keys if key in self]
        if len(given) > 1:
            first, second = given[:2]
            self.fail(first, f"and {second} = {shown(self.values[second])} are both given; keep one")

    def number(self, key: str, default: float | None, limits: Limits = ANY) -> float:
        """A number within `limits`; `default` None requires the key."""
        if key not in self:
            return self.missing(key, f"give {limits.remedy}") if default is None else default
        value = self.values[key]
        if not is_number(value):
            self.fail(key, f"is not a number; give {limits.remedy}")
        if not limits.contains(value):
            self.fail(key, f"is out of range; give {limits.remedy}")
        return float(value)

    def count(self, key: str, default: int) -> int:
        """A whole number within COUNT, such as pixels along a side or segments of a path."""
        if key in self and not (type(self.values[key]) is int and COUNT.contains(self.values[key])):
            self.fail(key, f"is out of range; give {COUNT.remedy}")
        return self.values.get(key, default)

    def vector(self, key: str, default: Vector | None, limits: Limits = ANY) -> Vector:
        """Three numbers, each within `limits`; `default` None requires the key."""
        if key not in self:
            return self.missing(key, "give [x, y, z]") if default is None else default
        value = self.values[key]
        if not (isinstance(value, (list, tuple)) and len(value) == 3 and all(map(is_number, value))):
            self.fail(key, f"is not three numbers; give [x, y, z], each {limits.remedy}")
        if not all(map(limits.contains, value)):
            self.fail(key, f"is out of range; give three values, each {limits.remedy}")
        return as_vector(value)

    def pair(self, key: str, limits: Limits = ANY) -> tuple[float, float]:
        """Two numbers, each within `limits`, of a required key."""
        value = self.values[key]
        if not (isinstance(value, (list, tuple)) and len(value) == 2 and all(map(is_number, value))):
            self.fail(key, f"is not two numbers; give two in brackets, each {limits.remedy}")
        if not all(map(limits.contains, value)):
            self.fail(key, f"is out of range; give two values, each {limits.remedy}")
        return float(value[0]), float(value[1])

    def direction(self, key: str) -> Vector:
        """The unit vector along the required vector `key`, whose length is above 0."""
        vector = self.vector(key, None)
        length = math.hypot(*vector)
        if length < SMALLEST:
            self.fail(key, "has no direction; give [x, y, z] other than 0")
        return as_vector(component / length for component in vector)

    def text(self, key: str) -> str:
        """A string, which is empty only if the key is absent."""
        if key in self and not (isinstance(self.values[key], str) and self.values[key]):
            self.fail(key, 'is not a text; write it in quotes, as in "name"')
        return self.values.get(key, "")

    def flag(self, key: str, default: bool = False) -> bool:
        """A boolean."""
        if key in self and not isinstance(self.values[key], bool):
            self.fail(key, "is neither true nor false; give one of them")
        return self.values.get(key, default)
