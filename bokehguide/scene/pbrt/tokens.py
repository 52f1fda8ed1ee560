"""Tokens of pbrt files: words, quoted texts, and lists in brackets."""

from __future__ import annotations

import gzip
import re
import warnings
import zlib
from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.limits import LARGEST, most_decoded
from bokehguide.scene.files import SceneFiles, require_file

TOKEN = re.compile(r'(?:[\s\ufeff]|#[^\n\r]*)*+("(?:[^"\\\n]|\\.)*"|[\[\]]|[^\s"\[\]]+|")')
"""Blanks and comments, then one token: a quoted text, a bracket or a word; a quote alone begins an unterminated text."""
ESCAPED = re.compile(r"\\(.)")
FAR = ("focaldistance", "yon")
"""Distances for which files write numbers such as 1e30."""
ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "b": "\b", "f": "\f"}
LONG_TEXT = 1000
"""Characters of a list from which its numbers are read without strings."""
MOST_TEXT = 2**30
"""Characters of all files of a scene, counted each time that a file is included."""


@dataclass(frozen=True)
class Source:
    """A file and its text."""

    path: Path
    text: str

    @cached_property
    def line_ends(self) -> list[int]:
        """Offsets of the ends of all lines."""
        return [found.start() for found in re.finditer("\n", self.text)]


@dataclass(frozen=True)
class Place:
    """A position in a file, written as FILE:LINE."""

    source: Source
    offset: int

    def __str__(self) -> str:
        return f"{self.source.path}:{bisect_left(self.source.line_ends, self.offset) + 1}"

    @property
    def short(self) -> str:
        """The position without the folder."""
        return str(self).removeprefix(f"{self.source.path.parent}/")

    def fail(self, problem: str) -> NoReturn:
        """Raise BokehguideError for the `problem` at this place."""
        raise BokehguideError(f"{self}: {problem}")


def read_source(path: Path, files: SceneFiles, place: str = "") -> Source:
    """The text of a file; names that end in `.gz` are decompressed. place: where the file is named.

    Raises BokehguideError for a file that is missing, damaged or no UTF-8.
    """
    require_file(path, "pbrt file", place)
    try:
        return Source(path, read_bytes(path, files).decode("utf-8"))
    except UnicodeDecodeError as error:
        raise BokehguideError(f"{path}: not a readable pbrt file ({reason(error)}); save it as UTF-8") from None


def read_bytes(path: Path, files: SceneFiles) -> bytes:
    """The bytes of a file with geometry, decompressed if its name ends in `.gz`.

    Raises BokehguideError for a damaged file, and for one that decompresses to more than `most_decoded` bytes.
    """
    try:
        data = files.read(path)
        if path.suffix.lower() != ".gz":
            return data
        most = most_decoded(len(data))
        with gzip.open(path) as stream:
            text = stream.read(most + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise BokehguideError(f"{path}: cannot be read ({reason(error)}); give an intact file") from None
    if len(text) > most:
        raise BokehguideError(f"{path}: decompresses to more than {most:,} bytes; give the uncompressed file")
    return text


class Tokens:
    """The tokens of a file in order. `next` is None after the last one."""

    def __init__(self, source: Source):
        self.source, self._offset = source, 0
        self.next: str | None = None
        self._advance()

    def _advance(self) -> None:
        found = TOKEN.match(self.source.text, self._offset)
        self.next = found.group(1) if found else None
        self.place = Place(self.source, found.start(1) if found else len(self.source.text))
        self._offset = found.end() if found else self._offset

    def take(self, wanted: str) -> str:
        """The next token. Raises BokehguideError at the end of the file. wanted: for the message."""
        if self.next is None:
            self.place.fail(f"the file ends where {wanted} should stand; add it")
        token = self.next
        if token == '"':
            self.place.fail("a text without its closing quote; add it on the same line")
        self._advance()
        return token

    def text(self, wanted: str) -> str:
        """A quoted text."""
        place, token = self.place, self.take(wanted)
        if token[0] != '"':
            place.fail(f"{printable(token)!r} stands where {wanted} should; write it in quotes")
        return unquoted(token)

    def numbers(self, count: int, what: str) -> list[float]:
        """So many numbers, without brackets or within them."""
        bracketed = self.next == "["
        if bracketed:
            self.take(what)
        values = []
        for _ in range(count):
            place = self.place
            values.append(number(self.take(f"a number of {what}"), place, what))
        if bracketed and self.take(f"] after the {count} numbers of {what}") != "]":
            self.place.fail(f"{what} has more than {count} numbers; leave the others out")
        return values

    def values(self, what: str) -> list[Any] | np.ndarray:
        """The values of a parameter: an array of numbers, or a list of texts and booleans."""
        place = self.place
        if self.next != "[":
            return _plain([self.take(f"the value of {what}")], place, what)
        end = self.source.text.find("]", self._offset)
        inside = self.source.text[self._offset : end] if end >= 0 else ""
        if end >= 0 and '"' not in inside and "#" not in inside and "[" not in inside:
            self._offset = end + 1
            self._advance()
            numbers = _numbers(inside)
            return _plain(inside.split(), place, what) if numbers is None else _in_range(numbers, place, what)
        self.take("[")
        words: list[str] = []
        while (word := self.take(f"] after the values of {what}")) != "]":
            words.append(word)
        return _plain(words, place, what)


def unquoted(token: str) -> str:
    """The text within quotes."""
    inside = token[1:-1]
    return ESCAPED.sub(lambda found: ESCAPES.get(found[1], found[1]), inside) if "\\" in inside else inside


def number(word: str, place: Place, what: str) -> float:
    """A number from a token. Raises BokehguideError, naming `place`, for another token."""
    try:
        value = float(word)
    except ValueError:
        place.fail(f"{printable(word)!r} stands where a number of {what} should; give one")
    if not abs(value) <= LARGEST:
        place.fail(f"{printable(word)} is out of range in {what}; give a number up to {LARGEST:g}")
    return value


def _plain(words: list[str], place: Place, what: str) -> list[Any] | np.ndarray:
    """Tokens as an array of numbers, or as a list of texts and booleans."""
    first = words[0] if words else ""
    if first[:1] == '"' or first in ("true", "false"):
        if not all(word[0] == '"' or word in ("true", "false") for word in words):
            place.fail(f"{what} mixes texts and numbers; give values of one kind")
        return [unquoted(word) if word[0] == '"' else word == "true" for word in words]
    try:
        values = np.array(words, np.float64)
    except ValueError:
        values = np.array([number(word, place, what) for word in words])
    return _in_range(values, place, what)


def _numbers(text: str) -> np.ndarray | None:
    """A long text of numbers as an array, without a string for each number; None for a short or other text."""
    if len(text) < LONG_TEXT:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, np.float64, sep=" ")
        except (DeprecationWarning, ValueError):  # a word that is no number
            return None


def _in_range(values: np.ndarray, place: Place, what: str) -> np.ndarray:
    """`values`. Raises BokehguideError, naming `place`, for one that is not finite or too large, except of distances in FAR."""
    if what in FAR:
        values = values.clip(-LARGEST, LARGEST)
    if values.size and not np.abs(values).max() <= LARGEST:
        place.fail(f"{what} has a number that is not finite or beyond {LARGEST:g}; repair it")
    return values
