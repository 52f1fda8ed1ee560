"""Command-line options shared by the experiments."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

from bokehguide.cli.arguments import Parser, size, threads
from bokehguide.scene import BUILTIN, Overrides, Scene, load_scene
from bokehguide.train import MODES


def builtin(text: str) -> str:
    if text not in BUILTIN:
        raise argparse.ArgumentTypeError(f"{text!r} is not built in; choose from {', '.join(BUILTIN)}")
    return text


def experiment_parser(doc: str | None, frame: str, default_modes: str, scene: Callable[[str], str] = builtin) -> Parser:
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


def modes(text: str) -> list[str]:
    chosen = text.split(",")
    for mode in chosen:
        if mode not in MODES:
            raise argparse.ArgumentTypeError(f"{mode!r} is no mode; choose from {','.join(MODES)}")
    return chosen


def load_scenes(args: argparse.Namespace) -> list[Scene]:
    """The scenes of the command line at its size."""
    width, height = args.size
    return [load_scene(name, Overrides(width=width, height=height)) for name in args.scenes]
