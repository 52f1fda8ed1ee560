"""Checks that the dataclasses of a scene and the readers of scene files share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.limits import LARGEST, SMALLEST
from bokehguide.scene.tables import ANY, EXPOSURE, Limits, Table, did_you_mean, is_number, shown
from bokehguide.scene.vectors import Vector

MAX_BLADES = 64
GROUP_NAME = re.compile(r"[A-Za-z0-9_]{1,40}")
"""Names of light groups that are parts of the names of EXR channels in every compositor."""


class FieldError(BokehguideError):
    """A wrong value of a dataclass. The message begins with the class and its field, as in `Camera.fov: 200 is out of range`."""


@contextmanager
def located(place: str) -> Iterator[None]:
    """Put `place`, such as a file, before the message of any FieldError."""
    try:
        yield
    except FieldError as error:
        raise BokehguideError(f"{place}: {error}") from None


class Fields(Table):
    """The fields of a dataclass instance, read as those of a table.

    Each `check` method raises FieldError for a wrong value, and replaces a right value by its plain form: a NumPy number
    becomes a Python number, a list becomes a tuple, and an array gets the type and the layout that the renderer needs.
    """

    def __init__(self, owner: object):
        values = {name: plain(value) for name, value in vars(owner).items()}
        super().__init__(values, "", type(owner).__name__, values)
        self._owner = owner

    def place(self, key: str) -> str:
        """The class and the field, such as `Camera.fov`."""
        return f"{self.path}.{key}"

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise the error that the value of `key` has `problem`."""
        value = self.values[key]
        text = f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else printable(shown(value), 120)
        raise FieldError(f"{self.place(key)}: {text} {problem}")

    def keep(self, key: str, value: Any) -> None:
        """Replace the value of a field."""
        self.values[key] = value
        object.__setattr__(self._owner, key, value)  # the dataclasses are frozen

    def check_numbers(self, **limits: Limits) -> None:
        """Numbers within the limits of each key."""
        for key, limit in limits.items():
            self.keep(key, self.number(key, None, limit))

    def check_vectors(self, **limits: Limits) -> None:
        """Three numbers for each key, each within its limits."""
        for key, limit in limits.items():
            self.keep(key, self.vector(key, None, limit))

    def check_wholes(self, **limits: Limits) -> None:
        """Whole numbers within the limits of each key."""
        for key, limit in limits.items():
            value = self.values[key]
            if type(value) is not int or not limit.contains(value):
                self.fail(key, f"is out of range; give {limit.remedy}")
            self.keep(key, value)

    def check_flags(self, *keys: str) -> None:
        """Booleans."""
        for key in keys:
            self.keep(key, self.flag(key))

    def check_texts(self, *keys: str) -> None:
        """Strings, which may be empty."""
        for key in keys:
            if not isinstance(self.values[key], str):
                self.fail(key, 'is not a text; give one, as in "name"')

    def check_choice(self, key: str, names: Iterable[str]) -> None:
        """One of some names."""
        if self.values[key] not in tuple(names):
            self.fail(key, f"is unknown; {did_you_mean(str(self.values[key]), names)}")

    def check_direction(self, key: str) -> None:
        """A vector other than 0, which is scaled to length 1 where it is no rounded unit vector."""
        vector, unit = self.vector(key, None), self.direction(key)
        differs = max(abs(a - b) for a, b in zip(vector, unit)) > 1e-3  # rounded by the user
        self.keep(key, unit if differs else vector)

    def check_instances(self, kind: type, *keys: str, optional: bool = True) -> None:
        """Instances of a class, or None where they are optional."""
        for key in keys:
            value = self.values[key]
            if not (isinstance(value, kind) or (optional and value is None)):
                self.fail(key, f"is no {kind.__name__}; give {kind.__name__}(…){' or None' if optional else ''}")

    def check_tuple(self, key: str, count: int, limits: Limits = ANY) -> None:
        """So many numbers within limits; becomes a tuple."""
        values = self.values[key]
        if not (isinstance(values, (list, tuple)) and len(values) == count and all(map(is_number, values))):
            self.fail(key, f"is not {count} numbers; give them in brackets")
        if not all(map(limits.contains, values)):
            self.fail(key, f"is out of range; give {count} values, each {limits.remedy}")
        self.keep(key, tuple(map(float, values)))

    def check_sequence(self, key: str, kind: type) -> None:
        """A sequence of instances of a class; becomes a tuple."""
        value = self.values[key]
        if not isinstance(value, (list, tuple)):
            self.fail(key, f"is no list of {kind.__name__}; put it in brackets")
        for index, each in enumerate(value):
            if not isinstance(each, kind):
                found = printable(shown(each), 120)
                raise FieldError(f"{self.place(key)}[{index}]: {found} is no {kind.__name__}; give {kind.__name__}(…)")
        self.keep(key, tuple(value))

    def check_array(self, key: str, shape: tuple[int | str, ...], low: float = -LARGEST, whole: bool = False) -> np.ndarray:
        """An array of numbers from `low` to LARGEST: contiguous float32, or int32 where `whole`.

        shape: a length for each axis. A letter is any length above 0, and "N" may be 0 as well.
        """
        array = self._numbers(key, whole)
        if len(array.shape) != len(shape) or not all(map(_fits, array.shape, shape)):
            raise FieldError(f"{self.place(key)}: has shape {array.shape}, not {_text(shape)}; give an array of that shape")
        # NaN fails both comparisons. Minimum and maximum need no memory, and are much faster than np.isfinite.
        if array.size and not (array.min() >= low and array.max() <= LARGEST):
            rows = array.reshape(len(array), -1)
            bad = np.flatnonzero(~((rows >= low) & (rows <= LARGEST)).all(axis=1))
            first = printable(shown(array[bad[0]].tolist()), 120)
            problem = ("" if low < 0.0 else "negative, ") + f"not finite or beyond {LARGEST:g}"
            raise FieldError(f"{self.place(key)}[{bad[0]}] is {first}, {problem}; repair it ({len(bad)} such)")
        if whole:  # indices beyond int32 stay out of range, so that the caller rejects them
            array = array if array.dtype == np.int32 else np.clip(array, -1, np.iinfo(np.int32).max)
        array = np.ascontiguousarray(array, np.int32 if whole else np.float32)
        self.keep(key, array)
        return array

    def _numbers(self, key: str, whole: bool) -> np.ndarray:
        """The value of `key` as an array of numbers, which are whole where `whole`."""
        try:
            array = np.asarray(self.values[key])
        except ValueError:  # rows of different lengths
            array = np.asarray(None)
        if array.dtype.kind not in ("iu" if whole and array.size else "iuf"):
            self.fail(key, f"is no array of {'whole ' if whole else ''}numbers; give one")
        return array.astype(np.float32) if array.dtype == np.float16 else array  # float16 ends below LARGEST


def plain(value: Any) -> Any:
    """NumPy numbers as Python numbers, alone and in short sequences, and short vectors as lists."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)) and any(isinstance(each, np.generic) for each in value[:6]):
        return type(value)(map(plain, value))
    return value.tolist() if isinstance(value, np.ndarray) and value.ndim < 2 and value.size <= 6 else value


def _fits(length: int, wanted: int | str) -> bool:
    return length == wanted if isinstance(wanted, int) else length > 0 or wanted == "N"


def _text(shape: tuple[int | str, ...]) -> str:
    """A shape in the form of NumPy's."""
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def viewing_direction(table: Table, position: Vector, target: Vector, up: Vector) -> np.ndarray:
    """The unit vector from `position` to `target`. Fails if it is undefined or parallel to `up`. table: of the camera."""
    towards = np.subtract(target, position)
    distance = np.linalg.norm(towards)
    # float32 does not resolve smaller distances at this position.
    if distance <= max(SMALLEST, 1e-6 * np.abs(position).max()):
        table.fail("target", "equals position, so there is no direction to look; move one of them")
    forward = towards / distance
    height = np.linalg.norm(up)
    if height == 0.0:
        table.fail("up", "has no direction; give a vector such as [0, 1, 0]")
    if np.linalg.norm(np.cross(forward, np.divide(up, height))) < 1e-4:
        key = "up" if "up" in table else "target"
        table.fail(key, f"makes the camera look along up = {list(up)}; give another up")
    return forward


def iris_blades(table: Table, default: int = 0) -> int:
    """The number of blades of the table of an aperture, 0 for a disc."""
    blades = table.values.get("blades", default)
    if type(blades) is not int or (blades != 0 and not 3 <= blades <= MAX_BLADES):
        table.fail("blades", f"is out of range; give a whole number from 3 to {MAX_BLADES}, or 0 for a round aperture")
    return blades


def read_exposure(table: Table) -> float | None:
    """The exposure in EV, None for "auto"."""
    return None if table.values.get("exposure", "auto") == "auto" else table.number("exposure", None, EXPOSURE)


def check_light_group(table: Table, key: str = "light_group") -> str:
    """The name of a light group, empty for none. Fails for a name that EXR channels cannot have."""
    name = table.values.get(key, "")
    if not isinstance(name, str) or (name and not GROUP_NAME.fullmatch(name)):
        table.fail(key, 'is no name of a light group; give at most 40 letters, digits and underscores, as in "lamps"')
    return name
