"""`bokehguide render`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bokehguide.cli.checkpoints import Checkpoints
from bokehguide.cli.pictures import OVERRIDES, Pictures
from bokehguide.cli.report import write_json
from bokehguide.cli.steps import measure, take_steps
from bokehguide.errors import BokehguideError
from bokehguide.image import check_writable, remove_abandoned
from bokehguide.metrics import read_reference
from bokehguide.render import Film
from bokehguide.runtime.process import dedicate_process
from bokehguide.scene import FilmSettings, Inset, Overrides, Scene, load_scene
from bokehguide.train import AdaptiveLoop, Ranks, RenderLoop, RenderSettings, make_loop, restarts
from bokehguide.train.adaptive import HalvesFilm
from bokehguide.train.logger import run_folder


def run(options: argparse.Namespace) -> int:
    """Render to an EXR and a PNG; all input is checked before the first ray."""
    dedicate_process()
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    settings = settings_from(options, scene)
    check_device(settings.device)
    window = settings.window(scene.film.width, scene.film.height)
    reference = read_window(options.reference, scene, window) if options.reference else None
    out = options.out or Path(f"{scene.name}-{settings.mode}.exr")
    check_outputs(out, options, run_folder(options.logdir or "", scene, settings))
    with Ranks.join(settings.device) as ranks:
        if ranks.first:
            print_warnings(scene)
        with make_loop(scene, settings, ranks) as loop:
            return render(loop, options, reference, out)


def render(loop: RenderLoop | AdaptiveLoop, options: argparse.Namespace, reference: Tensor | None, out: Path) -> int:
    """Render from the first step or from a checkpoint, and write the files; returns the exit code. Collective."""
    first = loop.ranks.first
    checkpoints = Checkpoints(out.with_suffix(".ckpt"), options.checkpoint_every, silent=not first)
    earlier = checkpoints.begin(loop, options.resume or restarts() > 0)
    pictures = Pictures(out, options)
    end, report = take_steps(loop, options, reference, checkpoints, pictures, earlier)
    picture = loop.picture()
    summary = report.finish(loop, picture, measure(picture, reference))
    if first:
        pictures.write(loop, picture)
        if options.json:
            write_json(options.json, summary)
        print_summary(summary, picture, end)
        print_files(loop, pictures, checkpoints)
        print_problems(loop, picture, checkpoints, end)
    return 128 + end if isinstance(end, int) else 0


def settings_from(options: argparse.Namespace, scene: Scene) -> RenderSettings:
    """The settings of the command line. Raises BokehguideError for a value out of range."""
    names = ("mode", "spp", "seed", "device", "threads", "reuse_radius", "target_noise", "compile")
    crop = options.crop and crop_pixels(options.crop, scene.film)
    return RenderSettings(**{name: getattr(options, name) for name in names}, crop=crop)


def crop_pixels(box: tuple[float, ...], film: FilmSettings) -> tuple[int, int, int, int]:
    """The box in pixels; one at most 1 wide and high is in fractions of the frame."""
    if max(box[2:]) <= 1.0:
        rows, columns = Inset(*box).pixels(film.width, film.height)
        return columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start
    x, y, width, height = (int(value) for value in box)
    return x, y, width, height


def read_window(path: Path, scene: Scene, window: tuple[int, int, int, int]) -> Tensor:
    """The window (left, top, width, height) of a reference of the frame. Raises BokehguideError as `read_reference`."""
    left, top, width, height = window
    return read_reference(path, scene.film.width, scene.film.height)[top : top + height, left : left + width]


def overrides_from(options: argparse.Namespace) -> Overrides:
    """The overrides of the scene on the command line."""
    width, height = options.size or (None, None)
    return Overrides(width=width, height=height, **{name: getattr(options, name) for name in OVERRIDES})


def check_device(device: str) -> None:
    """Raise BokehguideError if torch finds no such device."""
    if device == "cuda" and not torch.cuda.is_available():
        raise BokehguideError("--device cuda: torch finds no CUDA device here; give --device cpu")


def check_outputs(out: Path, options: argparse.Namespace, log_folder: Path) -> None:
    """Raise BokehguideError if an output cannot be written or is an input."""
    png, checkpoint = out.with_suffix(".png"), out.with_suffix(".ckpt")
    for option, path in (("--reference", options.reference), ("--json", options.json)):
        if path is not None and path.resolve() in (out.resolve(), png.resolve(), checkpoint.resolve()):
            raise BokehguideError(f"{option}: {str(path)!r} is an output of this command; give another path")
    if options.json and options.reference and options.json.resolve() == options.reference.resolve():
        raise BokehguideError(f"--json: {str(options.json)!r} is the reference; give another path")
    for path in (out, png, checkpoint):
        check_writable(path)
        remove_abandoned(path)
    if options.json:
        check_writable(options.json)
    if options.logdir:
        check_writable(log_folder / "events")


def print_warnings(scene: Scene) -> None:
    """Print the warnings of the scene's files and its likely mistakes on stderr."""
    for warning in (*scene.warnings, *scene.likely_mistakes):
        print(f"bokehguide: warning: {warning}", file=sys.stderr)


def print_summary(summary: dict[str, Any], picture: Film | HalvesFilm, end: int | str | None) -> None:
    """Print SPP, time, speed and errors, and the reason of an early end."""
    errors = f", MAPE {summary['mape']:.5f}, relMSE {summary['relmse']:.5f}" if "mape" in summary else ""
    if "estimated_mape" in summary:
        mean = summary["samples"] / (picture.width * picture.height)
        errors = f", {mean:.1f} per pixel, estimated MAPE {summary['estimated_mape']:.5f}{errors}"
    rate = summary["samples_per_second"] / 1e6
    print(f"{summary['spp']} SPP in {summary['seconds']:.1f} s, {rate:.2f} million samples/s{errors}")
    if isinstance(end, str):
        print(f"stopped: {end}")


def print_files(loop: RenderLoop | AdaptiveLoop, pictures: Pictures, checkpoints: Checkpoints) -> None:
    """Print the paths of the written files."""
    print(f"wrote {pictures.path} and {pictures.png}")
    if checkpoints.holds(loop):
        size = checkpoints.path.stat().st_size / 2**20
        print(f"wrote {checkpoints.path} ({size:.1f} MB); --resume continues it to more SPP")


def print_problems(
    loop: RenderLoop | AdaptiveLoop, picture: Film | HalvesFilm, checkpoints: Checkpoints, end: int | str | None
) -> None:
    """Print on stderr whether samples were left out, and whether a signal ended the render."""
    if picture.bad_count:
        bad = picture.bad_samples[0]
        print(
            f"bokehguide: warning: {picture.bad_count} NaN or infinite samples were left out; the first: "
            f"pixel ({bad.x}, {bad.y}), step {bad.step}, --seed {bad.seed}",
            file=sys.stderr,
        )
    if isinstance(end, int):
        saved = f"; saved, --resume continues from {checkpoints.path}" if checkpoints.holds(loop) else ""
        print(f"bokehguide: interrupted at {loop.step_number} of {loop.settings.spp} SPP{saved}", file=sys.stderr)
