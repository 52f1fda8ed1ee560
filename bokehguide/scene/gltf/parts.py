"""Checked reading of the JSON objects of a glTF file."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, NoReturn, TypeVar

from bokehguide.errors import BokehguideError, printable
from bokehguide.limits import MAX_INT
from bokehguide.scene.tables import ANY, Limits, Table, is_number, shown
from bokehguide.scene.vectors import Vector, as_vector

ROUNDING = 1e-6
"""Relative error of numbers in files: a white of 1.00000012 is 1 plus one digit of single precision."""
Default = TypeVar("Default", int, None)


class Part(Table):
    """One JSON object of a glTF file, such as a node. A null value counts as absent.

    Its readers raise BokehguideError naming file, object, key and value. They ignore unknown keys,
    as the format is extensible.
    """

    def __init__(self, values: Any, file: str, path: str):
        if not isinstance(values, dict):
            place = f"{file}: {path}" if path else file
            raise BokehguideError(f"{place}: {shown(values)} is not a JSON object; repair the file")
        present = {key: value for key, value in values.items() if value is not None}
        super().__init__(present, file, path, present)

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise the error that the value of `key` has `problem`, or that `key` is absent."""
        if key not in self:
            self.missing(key, "repair the file")
        super().fail(key, problem)

    def missing(self, key: str, remedy: str) -> NoReturn:
        """Raise the error that `key` is absent."""
        super().missing(key, "repair the file")

    def whole(self, key: str, default: Default, most: int = MAX_INT) -> int | Default:
        """A whole number from 0 to `most`."""
        if key not in self:
            return default
        value = self.values[key]
        if not is_number(value) or not 0 <= value <= most or value != int(value):
            self.fail(key, f"is not a whole number from 0 to {most}; repair the file")
        return int(value)

    def number(self, key: str, default: float | None, limits: Limits = ANY) -> float:
        """A number within `limits`, as exporters round it."""
        return _rounded(super().number(key, default, _tolerant(limits)), limits)

    def vector(self, key: str, default: Vector | None, limits: Limits = ANY) -> Vector:
        """Three numbers, each within `limits`, as exporters round them."""
        return as_vector(_rounded(value, limits) for value in super().vector(key, default, _tolerant(limits)))

    def numbers(self, key: str, count: int, default: tuple[float, ...], limits: Limits = ANY) -> tuple[float, ...]:
        """`count` numbers, each within `limits`, as exporters round them."""
        if key not in self:
            return default
        values = self.values[key]
        if not (isinstance(values, list) and len(values) == count and all(map(is_number, values))):
            self.fail(key, f"is not a list of {count} numbers; repair the file")
        if not all(map(_tolerant(limits).contains, values)):
            self.fail(key, f"is out of range; give {count} values, each {limits.remedy}")
        return tuple(_rounded(float(value), limits) for value in values)

    def part(self, key: str) -> Part:
        """The object `key`, empty if absent."""
        return Part(self.values.get(key, {}), self.file, f"{self.path}.{key}" if self.path else key)

    def parts(self, key: str) -> list[Part]:
        """The objects of the list `key`, empty if absent. Their paths contain index and name."""
        values = self.values.get(key, [])
        if not isinstance(values, list):
            self.fail(key, "is not a list; repair the file")
        path = f"{self.path}.{key}" if self.path else key
        return [Part(value, self.file, f"{path}[{index}]{_named(value)}") for index, value in enumerate(values)]

    @cached_property
    def extensions(self) -> dict[str, Any]:
        """The values of the extensions by name."""
        return self.part("extensions").values

    def extension(self, name: str) -> Part:
        """The extension `name`, empty if absent."""
        return Part(self.extensions.get(name, {}), self.file, f"{self.path}.{name}" if self.path else name)

    @property
    def label(self) -> str:
        """The object's name, or its path in the file if it has none."""
        name = self.values.get("name")
        return printable(name) if isinstance(name, str) and name.strip() else self.path


def _tolerant(limits: Limits) -> Limits:
    """`limits` that also contain a value above the largest by an error of rounding."""
    return replace(limits, high=limits.high * (1.0 + ROUNDING))


def _rounded(value: float, limits: Limits) -> float:
    """`value`, or the largest value of `limits` if it is just above."""
    return limits.high if limits.high < value <= _tolerant(limits).high else value


def _named(value: Any) -> str:
    """The suffix of an object's path: its name in parentheses, or nothing."""
    name = value.get("name") if isinstance(value, dict) else None
    return f" ({printable(name)})" if isinstance(name, str) and name.strip() else ""
