"""The options of `bokehguide`. Imports nothing heavy, so that `--help` is instant."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bokehguide import __version__
from bokehguide.cli.parser import (
    TEV_PORT,
    Parser,
    address,
    bits,
    crop,
    depth,
    duration,
    exposure,
    exr,
    inset,
    json_output,
    modes,
    natural,
    number,
    png,
    point,
    port,
    positive,
    seconds,
    size,
    threads,
    vector,
)
from bokehguide.errors import BokehguideError, encoding_problem
from bokehguide.guiding.modes import MODES
from bokehguide.limits import VIEWS

SHARED: dict[str, dict[str, Any]] = {
    "scene": {
        "metavar": "SCENE",
        "help": "a built-in scene (see `bokehguide scenes`), a .toml, Mitsuba .xml or pbrt .pbrt file, a .usd .usda .usdc .usdz "
        "stage, or a .glb .gltf .obj .ply .stl model",
    },
    "--reuse-radius": {
        "type": number,
        "metavar": "PX",
        "help": "radius in pixels in which area-restir reuses samples (default: 50, for images 1920 wide)",
    },
    "--size": {"type": size, "metavar": "WxH", "help": "pixels (default: the scene's)"},
    "--seed": {"type": natural, "default": 0, "metavar": "N", "help": "seed of the random numbers (default: 0)"},
    "--device": {"choices": ("cpu", "cuda"), "default": "cpu", "help": "device of the tensors (default: cpu)"},
    "--threads": {"type": threads, "metavar": "N", "help": "threads for tracing and shading (default: one per core)"},
}
"""Arguments of `add_argument` for what several commands take."""


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The options of one command, whose name is `command`, and `started`, the present time of `time.monotonic`.

    Raises BokehguideError for a mistake.
    """
    for argument in arguments:
        if problem := encoding_problem(argument):
            raise BokehguideError(f"{argument!r} {problem}")
    words, parser = _attach_negative_values(arguments), make_parser()
    parser.require_known(words)
    options, extra = parser.parse_known_args(words, argparse.Namespace(started=time.monotonic()))
    if extra:
        remedy = f"an option takes one word, with commas in lists; see `bokehguide {options.command} --help`"
        raise BokehguideError(f"unrecognized argument {extra[0]}; {remedy}")
    return options


def make_parser() -> Parser:
    """The parser of all commands; the documentation lists its options."""
    parser = Parser(
        prog="bokehguide",
        description="Renders defocused photographs by path tracing with guided lens sampling.",
    )
    parser.add_argument("--version", action="version", version=f"bokehguide {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_render(commands)
    _add_view(commands)
    _add_compare(commands)
    _add_develop(commands)
    _add_metrics(commands)
    _add_info(commands)
    _add_export(commands)
    commands.add_parser("scenes", help="list the built-in scenes")
    return parser


def _add_render(commands: argparse._SubParsersAction) -> None:
    render = commands.add_parser("render", help="render a scene to an EXR and a PNG")
    _add_render_options(render)
    facts = "write speed, memory, errors and times as a JSON object; -: to stdout, and the text to stderr"
    render.add_argument("--json", type=json_output, metavar="PATH|-", help=facts)
    live = f"show the picture during the render in the image viewer tev (default port: {TEV_PORT})"
    render.add_argument("--tev", type=address, metavar="HOST[:PORT]", help=live)


def _add_view(commands: argparse._SubParsersAction) -> None:
    view = commands.add_parser("view", help="open a page in the browser that shows a scene and sets its depth of field")
    add = view.add_argument
    shown = view.add_mutually_exclusive_group(required=True)
    shown.add_argument("scene", nargs="?", **SHARED["scene"])
    watch = "follow a render that runs elsewhere, by the file that it writes"
    shown.add_argument("--watch", type=exr, metavar="OUT.exr", help=watch)
    add("--host", default="127.0.0.1", metavar="HOST", help="address to listen on (default: 127.0.0.1, this machine alone)")
    add("--port", type=port, default=8737, metavar="N", help="port to listen on; 0: any free port (default: 8737)")
    add("--no-browser", action="store_true", help="print the address, and open no browser")
    add("--mode", choices=MODES, default="guided", help="how the lens is sampled at first (default: guided)")
    add("--spp", type=positive, default=64, metavar="N", help="samples per pixel of a render (default: 64)")
    _add_shared(add, "--size", "--seed", "--threads")
    _add_display(add)
    add("--noisy", action="store_true", help="show the picture without denoising at first")
    _add_allow_outside(view)
    _add_overrides(view)


def _add_info(commands: argparse._SubParsersAction) -> None:
    info = commands.add_parser("info", help="print a scene as `render` with the same options sees it, and likely mistakes")
    _add_render_options(info)
    facts = "write the facts as a JSON object; -: to stdout, and the text to stderr"
    info.add_argument("--json", type=json_output, metavar="PATH|-", help=facts)
    view = "write a quick pinhole view in which the plane of focus is marked"
    info.add_argument("--picture", type=png, metavar="PATH.png", help=view)


def _add_render_options(render: argparse.ArgumentParser) -> None:
    add = render.add_argument
    _add_shared(add, "scene")
    add("--mode", choices=MODES, default="guided", help="how the lens is sampled (default: guided)")
    _add_shared(add, "--reuse-radius")
    add("--spp", type=positive, default=256, metavar="N", help="samples per pixel (default: 256)")
    _add_shared(add, "--size", "--seed")
    add("--out", type=exr, metavar="PATH.exr", help="output file; a PNG goes beside it (default: SCENE-MODE.exr)")
    add("--logdir", type=Path, metavar="DIR", help="write TensorBoard logs into DIR/SCENE/MODE")
    add("--reference", type=Path, metavar="REF.exr", help="report the error against this image during the render")
    _add_shared(add, "--device", "--threads")
    _add_display(add)
    _add_png(add)
    add("--denoise", action="store_true", help="also write a denoised picture into the EXR, and show it in the PNG")
    mattes = "also write mattes of objects and materials through the lens into the EXR, as Cryptomatte layers"
    add("--cryptomatte", action="store_true", help=mattes)
    groups = "also write the light of each light group of the scene into the EXR, as layers whose sum is the picture"
    add("--light-groups", action="store_true", help=groups)
    box = "render only this box: in pixels from the top left, or in fractions of the frame if all are from 0 to 1"
    add("--crop", type=crop, metavar="X,Y,W,H", help=box)
    limit = "stop before a step that would exceed this time, loading included; at least one step is taken"
    add("--time-limit", type=duration, metavar="SECONDS", help=limit)
    noise = "stop each block of 32 x 32 pixels at this estimated relative error; --spp is the limit"
    add("--target-noise", type=number, metavar="X", help=noise)
    every = "save the state in PATH.ckpt at this interval and keep the file; 0: never (default: 60, removed at a regular end)"
    add("--checkpoint-every", type=seconds, metavar="SECONDS", help=every)
    add("--resume", action="store_true", help="continue from PATH.ckpt, if it exists, up to --spp in total")
    _add_allow_outside(render)
    _add_overrides(render)


def _add_compare(commands: argparse._SubParsersAction) -> None:
    compare = commands.add_parser("compare", help="compare modes on a scene: errors, convergence, crops")
    add = compare.add_argument
    _add_shared(add, "scene")
    add(
        "--modes",
        type=modes,
        default="uniform,lis,lis-b,lis-o,guided",
        metavar="A,B,...",
        help="default: uniform,lis,lis-b,lis-o,guided",
    )
    add("--spp", type=positive, default=256, metavar="N", help="samples per pixel of each mode (default: 256)")
    _add_shared(add, "--reuse-radius")
    add("--out", type=Path, required=True, metavar="DIR", help="output folder; finished modes in it are not rendered again")
    reference = compare.add_mutually_exclusive_group()
    reference.add_argument(
        "--reference", type=Path, metavar="REF.exr", help="compare with this image (default: a new reference is rendered)"
    )
    spp = "samples per pixel of a new reference (default: 16 times --spp)"
    reference.add_argument("--reference-spp", type=positive, metavar="N", help=spp)
    add("--cache", type=Path, metavar="DIR", help="folder of rendered references (default: the user's cache folder)")
    box = "measure in this box instead of the scene's insets, in fractions of the frame from its top left; may be repeated"
    add("--inset", type=inset, action="append", default=[], metavar="X,Y,W,H", help=box)
    _add_shared(add, "--size", "--device", "--threads")
    _add_display(add)
    _add_allow_outside(compare)
    _add_overrides(compare)


def _add_shared(add: Callable[..., object], *names: str) -> None:
    for name in names:
        add(name, **SHARED[name])


def _add_display(add: Callable[..., object]) -> None:
    stops = "exposure of display images, or auto to meter the picture (default: the scene's, or auto)"
    add("--exposure", type=exposure, metavar="auto|EV", help=stops)
    views = "display transform: photo keeps the hue of emitters, aces is ACES 2.0, srgb clips (default: photo)"
    add("--view", choices=VIEWS, default=VIEWS[0], help=views)


def _add_png(add: Callable[..., object]) -> None:
    add("--alpha", action="store_true", help="make the PNG transparent where the picture is: RGBA with straight alpha")
    add("--bits", type=bits, default=8, metavar="8|16", help="bits per channel of the PNG (default: 8)")


def _add_develop(commands: argparse._SubParsersAction) -> None:
    develop = commands.add_parser("develop", help="make a new PNG from an EXR")
    add = develop.add_argument
    add("picture", type=exr, metavar="PICTURE.exr")
    stops = "exposure, or auto to meter the picture (default: the exposure in the file, or auto)"
    add("--exposure", type=exposure, metavar="auto|EV", help=stops)
    add("--view", choices=VIEWS, help="display transform (default: the view in the file, or photo)")
    _add_png(add)
    add("--denoise", action="store_true", help="show the denoised picture in the file, or denoise")
    add("--out", type=png, metavar="PATH.png", help="output file (default: PICTURE.png)")


def _add_allow_outside(command: argparse.ArgumentParser) -> None:
    trust = "allow paths in the scene's files to leave its folder"
    command.add_argument("--allow-outside", action="store_true", help=trust)


def _add_overrides(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("camera and light of a model, or overrides of a scene file")
    add = group.add_argument
    add("--environment", metavar="MAP|R,G,B|none", help="a .hdr or .exr map, a constant radiance, or no environment")
    add("--environment-rotation", type=number, metavar="DEG", help="rotation of the map about +y, anticlockwise from above")
    hide = "hide environment and suns from the camera, as Blender's transparent film does; their light stays, and alpha is 0"
    add("--hide-environment", action="store_true", default=None, help=hide)
    lens = group.add_mutually_exclusive_group()
    lens.add_argument("--f-number", type=number, metavar="N", help="focal length / diameter of the lens, on the scene's sensor")
    lens.add_argument("--aperture-radius", type=number, metavar="M", help="metres; 0: a pinhole")
    focus = group.add_mutually_exclusive_group()
    focus.add_argument("--focus-distance", type=number, metavar="M", help="metres along the optical axis; inf: infinity")
    at = "focus on the surface at this point, in pixels from the top left, or in fractions of the frame if both are at most 1"
    focus.add_argument("--focus-at", type=point, metavar="X,Y", help=at)
    focus.add_argument("--focus-on", metavar="NAME", help="focus on the visible part of an object, a glTF node or a material")
    add("--camera", metavar="NAME", help="a camera of the model by name or number, or `frame`: one that frames the model")
    add("--variant", metavar="NAME", help="a material variant of a glTF model, or SET=NAME,... of a USD stage (default: its own)")
    add(
        "--time",
        type=number,
        metavar="SECONDS",
        help="time of a glTF or USD model's animations (default: the pose at rest, or a stage's start)",
    )
    add("--camera-position", type=vector, metavar="X,Y,Z", help="metres")
    add("--camera-target", type=vector, metavar="X,Y,Z", help="metres")
    add("--fov", type=number, metavar="DEG", help="horizontal field of view in degrees")
    add("--max-depth", type=depth, metavar="N", help="longest path in segments; glass needs more (default: the scene's, or 6)")
    add("--aperture-blades", type=natural, metavar="N", help="blades of the iris; 0: round")
    add("--aperture-rotation", type=number, metavar="DEG", help="rotation of the blades or of the mask, anticlockwise")
    add("--aperture-curvature", type=number, metavar="X", help="curvature of the blades: 0 straight, 1 a circle")
    add("--aperture-ratio", type=number, metavar="X", help="divides the width of the opening, as anamorphic lenses do")
    add("--aperture-cat-eye", type=number, metavar="X", help="vignetting towards the corners, 0 to 1.5")
    add("--aperture-edge", type=number, metavar="X", help="bright rim, up to 1, or bright centre, down to -1")
    add("--aperture-image", metavar="PATH", help="a grey mask in place of blades")


def _add_export(commands: argparse._SubParsersAction) -> None:
    export = commands.add_parser("export", help="write a scene for another renderer")
    add = export.add_argument
    _add_shared(add, "scene")
    add("--to", choices=("mitsuba",), required=True, help="the renderer: Mitsuba 3, as XML with PLY and EXR files")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for scene.xml, meshes and textures")
    _add_shared(add, "--size")
    _add_allow_outside(export)
    _add_overrides(export)


def _add_metrics(commands: argparse._SubParsersAction) -> None:
    metrics = commands.add_parser("metrics", help="compare two images: MAPE, relMSE, SSIM, PSNR")
    add = metrics.add_argument
    add("image", type=Path, metavar="IMAGE.exr")
    add("reference", type=Path, metavar="REFERENCE.exr")
    insets = "also compare this box, in fractions of the frame from its top left; may be repeated"
    add("--inset", type=inset, action="append", default=[], metavar="X,Y,W,H", help=insets)
    facts = "write the measures as a JSON object; -: to stdout, and the text to stderr"
    add("--json", type=json_output, metavar="PATH|-", help=facts)


def _attach_negative_values(arguments: Sequence[str]) -> list[str]:
    """Join `--option -1,2,3` to `--option=-1,2,3`, and `--option -inf` alike; argparse would read two options."""
    joined: list[str] = []
    for argument in arguments:
        if re.match(r"-(\.?[0-9]|inf|nan)", argument, re.IGNORECASE) and joined and re.fullmatch(r"--[a-z-]+", joined[-1]):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined
