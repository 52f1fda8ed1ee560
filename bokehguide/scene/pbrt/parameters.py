"""Parameters of a directive, such as `"float fov" 40`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, NoReturn

import numpy as np

from bokehguide.errors import printable
from bokehguide.limits import MAX_INT
from bokehguide.scene.pbrt.tokens import Place, Tokens
from bokehguide.scene.vectors import Vector, as_vector

SIZES = {"point2": 2, "vector2": 2, "point3": 3, "vector3": 3, "normal": 3, "normal3": 3, "rgb": 3, "xyz": 3}
"""Numbers of one value, by type."""
SIZES |= {"point": 3, "vector": 3, "color": 3, "float": 1, "integer": 1, "blackbody": 1, "spectrum": 1}
SIMILAR = 0.8
"""Least similarity of a name to the name that it may stand for."""
WORDS = {"string", "texture", "bool", "spectrum"}
"""Types whose values may be texts or booleans."""


@dataclass(frozen=True)
class Parameter:
    """A parameter. values: numbers as an array, others as a list. space: the colour space of an `rgb`."""

    type: str
    values: Any
    place: Place
    space: str = "srgb"


@dataclass
class Parameters:
    """The parameters of a directive by name. kind: the name of the directive's plugin, such as "perspective"."""

    kind: str
    place: Place
    values: dict[str, Parameter] = field(default_factory=dict)
    asked: set[str] = field(default_factory=set)

    def __contains__(self, key: str) -> bool:
        self.asked.add(key)
        return key in self.values

    def misspelt(self) -> Iterator[tuple[str, str]]:
        """Names of parameters that nothing has read, each with the similar name of one that was missing."""
        missing = sorted(self.asked - self.values.keys())
        for key in self.values.keys() - self.asked:
            for near in get_close_matches(key, missing, 1, SIMILAR):
                yield key, near

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise BokehguideError: the value of `key` has `problem`."""
        found = self.values[key]
        shown = printable(" ".join(map(str, list(found.values[:6]))), 80)
        found.place.fail(f"{printable(key)}: {shown} {problem}")

    def numbers(self, key: str, size: int = 1) -> np.ndarray | None:
        """The rows `[N, size]` of numbers, None without the parameter."""
        if key not in self:
            return None
        values = self.values[key].values
        if not isinstance(values, np.ndarray):
            self.fail(key, "is no list of numbers; give some")
        if len(values) == 0 or len(values) % size:
            self.fail(key, f"has {len(values)} numbers; give a multiple of {size}")
        return values.reshape(-1, size)

    def integers(self, key: str) -> np.ndarray | None:
        """Whole numbers `[N]`, None without the parameter."""
        values = self.numbers(key)
        if values is not None and not (np.abs(values) <= MAX_INT).all():
            self.fail(key, "has a number beyond 32 bits; repair it")
        return None if values is None else values[:, 0].astype(np.int64)

    def number(self, key: str, default: float) -> float:
        """One number."""
        values = self.numbers(key)
        if values is not None and len(values) != 1:
            self.fail(key, "is not one number; give one")
        return default if values is None else float(values[0, 0])

    def vector(self, key: str, default: Vector) -> Vector:
        """Three numbers."""
        values = self.numbers(key, 3)
        if values is not None and len(values) != 1:
            self.fail(key, "is not three numbers; give three")
        return default if values is None else as_vector(values[0])

    def texts(self, key: str) -> list[str]:
        """Texts, none without the parameter."""
        values = self.values[key].values if key in self else []
        if isinstance(values, np.ndarray) or not all(isinstance(value, str) for value in values):
            self.fail(key, "is no text; write it in quotes")
        return values

    def text(self, key: str, default: str = "") -> str:
        """One text."""
        values = self.texts(key)
        if len(values) > 1 or (key in self.values and not values):
            self.fail(key, "is not one text; give one")
        return values[0] if values else default

    def flag(self, key: str, default: bool = False) -> bool:
        """A boolean; also in quotes, as in pbrt-v3."""
        if key not in self:
            return default
        values = self.values[key].values
        if isinstance(values, np.ndarray) or len(values) != 1 or values[0] not in (True, False, "true", "false"):
            self.fail(key, "is neither true nor false; give one of them")
        return values[0] in (True, "true")

    def texture(self, key: str) -> str | None:
        """The name of a texture, None where the parameter has another type."""
        found = self.values[key] if key in self else None
        return self.text(key) if found is not None and found.type == "texture" else None


def read_parameters(
    tokens: Tokens, kind: str, place: Place, inherited: Iterable[tuple[str, Parameter]], space: str
) -> Parameters:
    """The parameters that follow in `tokens`. inherited: defaults of the directive `Attribute`. space: the colour space.

    Raises BokehguideError for a malformed declaration, an unknown type, and values of another type.
    """
    read = Parameters(kind, place, dict(inherited))
    while tokens.next is not None and tokens.next[0] == '"':
        where = tokens.place
        words = tokens.text("a parameter").split()
        if len(words) != 2:
            where.fail(f'{printable(" ".join(words))!r} is no parameter; give a type and a name, as in "float fov"')
        type_, name = words
        values = tokens.values(printable(name))
        if type_ not in SIZES and type_ not in WORDS:
            where.fail(f"{printable(type_)!r} is no type of a parameter; known are {', '.join(sorted({*SIZES, *WORDS}))}")
        numeric = isinstance(values, np.ndarray)
        if len(values) and (type_ not in WORDS if not numeric else type_ not in SIZES):
            where.fail(f"{printable(name)}: values of another type than {type_}; give such values")
        read.values[name] = Parameter(type_, values, where, space)
    return read
