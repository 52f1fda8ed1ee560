"""A command-line parser with errors of one line, and the types of option values. Imports nothing heavy."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from bokehguide.errors import BokehguideError
from bokehguide.guiding.modes import MODES
from bokehguide.limits import LARGEST, MAX_EXPOSURE, MAX_INT, MAX_PIXELS, MAX_SIDE, MAX_THREADS
from bokehguide.scene.tables import did_you_mean, in_fractions, leaves_frame

STDOUT = "-"
"""The value of --json for the standard output; a file of this name is ./-."""
TEV_PORT = 14158
"""Port on which tev listens by default."""


class Parser(argparse.ArgumentParser):
    """A parser without abbreviations that reports a mistake in one line, as a BokehguideError, with the nearest known word."""

    def __init__(self, **keywords: Any) -> None:
        super().__init__(allow_abbrev=False, **keywords)

    def error(self, message: str) -> NoReturn:
        raise BokehguideError(f"{message}{' See' if message.endswith('?') else '; see'} `{self.prog} --help`")

    def require_known(self, arguments: Sequence[str]) -> None:
        """Raise BokehguideError for an option that the command lacks: argparse would first ask for missing arguments."""
        commands = next((each.choices for each in self._actions if isinstance(each, argparse._SubParsersAction)), None)
        for number, argument in enumerate(arguments):
            option = argument.partition("=")[0]
            if commands is not None and not argument.startswith("-"):
                if argument in commands:
                    commands[argument].require_known(arguments[number + 1 :])
                return
            if argument == "--":
                return
            if re.match(r"-[^\d.]", option) and " " not in option and option not in self._option_string_actions:
                known = [name[2:] for name in self._option_string_actions if name.startswith("--")]
                self.error(f"unrecognized option {option}; {did_you_mean(option.lstrip('-'), known, '--')}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, _no_choice(value, action.choices))


def positive(text: str) -> int:
    return _whole(text, 1)


def natural(text: str) -> int:
    return _whole(text, 0)


def depth(text: str) -> int:
    return _whole(text, 1, MAX_SIDE)


def threads(text: str) -> int:
    return _whole(text, 1, MAX_THREADS)


def bits(text: str) -> int:
    if text not in ("8", "16"):
        raise argparse.ArgumentTypeError(f"{text!r} is no depth of a PNG; give 8 or 16")
    return int(text)


def port(text: str) -> int:
    return _whole(text, 0, 65535)


def address(text: str) -> tuple[str, int]:
    """Host and port, from `HOST` or `HOST:PORT`."""
    host, colon, number = text.partition(":")
    if not host.strip():
        raise argparse.ArgumentTypeError(f"{text!r} names no host; give HOST or HOST:PORT, such as 127.0.0.1")
    return host, _whole(number, 1, 65535) if colon else TEV_PORT


def modes(text: str) -> tuple[str, ...]:
    """Names between commas, each once."""
    names = tuple(text.split(","))
    for name in names:
        if name not in MODES:
            raise argparse.ArgumentTypeError(_no_choice(name, MODES))
    if len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"{text!r} names a mode twice; give each once")
    return names


def number(text: str) -> float:
    """A number. The field of the option decides on its range, and on infinity and NaN."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number; give one, such as 0.5") from None


def exposure(text: str) -> float | str:
    if text == "auto":
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= MAX_EXPOSURE:
        limits = f"from {-MAX_EXPOSURE:g} to {MAX_EXPOSURE:g}"
        raise argparse.ArgumentTypeError(f"{text!r} is not EV; give a finite number {limits}, or auto")
    return value


def seconds(text: str) -> float:
    value = _numbers(text, "SECONDS")[0]
    if value < 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is negative; give seconds, or 0 for never")
    return value


def duration(text: str) -> float:
    value = _numbers(text, "SECONDS")[0]
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not positive; give seconds")
    return value


def crop(text: str) -> tuple[float, float, float, float]:
    """X,Y,W,H in pixels or fractions; RenderSettings checks that a box in pixels lies within the frame."""
    box = _numbers(text, "X,Y,W,H")
    if in_fractions(box):
        return inset(text)
    if any(value != int(value) for value in box):
        raise argparse.ArgumentTypeError(f"{text!r} is in pixels and not whole; give whole pixels, or fractions of the frame")
    x, y, width, height = (int(value) for value in box)
    return x, y, width, height


def size(text: str) -> tuple[int, int]:
    """Width and height in pixels, from `640x360`."""
    match = re.fullmatch(r"([1-9][0-9]*)x([1-9][0-9]*)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; give width x height in pixels, such as 640x360")
    width, height = (_whole(side, 1, MAX_SIDE) for side in match.groups())
    if width * height > MAX_PIXELS:
        raise argparse.ArgumentTypeError(f"{text!r} is too large; give at most {MAX_PIXELS} pixels in all")
    return width, height


def exr(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() != ".exr":
        raise argparse.ArgumentTypeError(f"{text!r} is no EXR; end it in .exr")
    return path


def png(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() != ".png":
        raise argparse.ArgumentTypeError(f"{text!r} is no PNG; end it in .png")
    return path


def json_output(text: str) -> Path | str:
    """The path of a JSON file, or STDOUT."""
    return text if text == STDOUT else json(text)


def json(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() in (".exr", ".png", ".ckpt"):
        raise argparse.ArgumentTypeError(f"{text!r} is the name of a picture or a checkpoint; give another path, such as a.json")
    return path


def point(text: str) -> tuple[float, float]:
    x, y = _numbers(text, "X,Y")
    return x, y


def vector(text: str) -> tuple[float, float, float]:
    x, y, z = _numbers(text, "X,Y,Z")
    return x, y, z


def inset(text: str) -> tuple[float, float, float, float]:
    x, y, width, height = _numbers(text, "X,Y,W,H")
    if leaves_frame(x, y, width, height):
        raise argparse.ArgumentTypeError(f"{text!r} leaves the frame; give X,Y,W,H as fractions of it, between 0 and 1")
    return x, y, width, height


def _no_choice(word: str, known: Iterable[str]) -> str:
    """The problem of a word that is none of `known`, with all of them and the nearest one."""
    hint = did_you_mean(word, known)
    return f"invalid choice: {word!r}; {hint}" + (f" Known are {', '.join(known)}" if hint.endswith("?") else "")


def _whole(text: str, least: int, most: int = MAX_INT) -> int:
    if not re.fullmatch(r"[0-9]{1,20}", text) or not least <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is not a whole number from {least} to {most}")
    return int(text)


def _numbers(text: str, form: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(form.split(",")) or not all(abs(value) <= LARGEST for value in values):
        wanted = "finite numbers without spaces" if "," in form else "a finite number"
        raise argparse.ArgumentTypeError(f"{text!r} is not {form}; give {wanted}, up to {LARGEST:g}")
    return values
