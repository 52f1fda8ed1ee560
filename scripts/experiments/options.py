"""Command-line options shared by the experiments."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

from real_scenes import SCENE_NAMES, load_any

from bokehguide.cli.parser import Parser, modes, positive, size, threads
from bokehguide.scene import BUILTIN, Scene


def known_scene(text: str) -> str:
    if text not in SCENE_NAMES:
        raise argparse.ArgumentTypeError(f"{text!r} is no scene; choose from {', '.join(SCENE_NAMES)}")
    return text


def experiment_parser(doc: str | None, frame: str, default_modes: str, scene: Callable[[str], str] = known_scene) -> Parser:
    """A parser with the options that all experiments share.

    frame, default_modes: defaults of `--size` and `--modes`; scene: reads the name of a scene.
    """
    parser = Parser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("scenes", nargs="*", default=list(BUILTIN), type=scene, metavar="SCENE", help="default: all built-in scenes")
    add("--size", type=size, default=size(frame), metavar="WxH", help=f"default: {frame}")
    add("--modes", type=modes, default=modes(default_modes), metavar="A,B,...", help=f"default: {default_modes}")
    add("--threads", type=threads, metavar="N", help="default: one per core")
    limit = "start no new render after this many seconds; the same command continues"
    add("--time-limit", type=float, default=math.inf, metavar="SECONDS", help=limit)
    return parser


def numbers(text: str) -> list[int]:
    """Positive whole numbers between commas, in ascending order, each once."""
    return sorted({positive(part) for part in text.split(",")})


def load_scenes(args: argparse.Namespace) -> list[Scene]:
    """The scenes of the command line at its size."""
    width, height = args.size
    return [load_any(name, width, height) for name in args.scenes]
