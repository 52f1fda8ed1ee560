"""`bokehguide render`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from torch import Tensor

from bokehguide.cli.checkpoints import Checkpoints
from bokehguide.cli.pictures import OVERRIDES, Pictures
from bokehguide.cli.report import write_json
from bokehguide.cli.steps import measure, take_steps
from bokehguide.errors import BokehguideError
from bokehguide.image import check_writable, remove_abandoned
from bokehguide.metrics import read_reference
from bokehguide.render import Film as RenderFilm
from bokehguide.scene import Film, Inset, Overrides, Scene, load_scene
from bokehguide.train import AdaptiveLoop, Ranks, RenderLoop, RenderSettings, make_loop, restarts
from bokehguide.train.logger import run_folder


def run(options: argparse.Namespace) -> int:
    """Render to an EXR and a PNG; everything that can be wrong is checked before the first ray."""
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    settings = settings_from(options, scene)
    check_device(settings.device)
    window = settings.window(scene.film.width, scene.film.height)
    reference = read_window(options.reference, scene, window) if options.reference else None
    out = options.out or Path(f"{scene.name}-{settings.mode}.exr")
    check_outputs(out, options, run_folder(options.logdir or "", scene, settings))
    with Ranks.join(settings.device) as ranks:
        if ranks.first:
            for warning in scene.warnings:
                print(f"bokehguide: warning: {warning}", file=sys.stderr)
        loop = make_loop(scene, settings, ranks)
        checkpoints = Checkpoints(out.with_suffix(".ckpt"), options.checkpoint_every, ranks.first)
        earlier = checkpoints.begin(loop, options.resume or restarts() > 0)
        pictures = Pictures(out, options)
        end, report = take_steps(loop, options, reference, checkpoints, pictures, earlier)
        picture = loop.picture()
        summary = report.finish(loop, picture, measure(picture, reference))
        if ranks.first:
            pictures.write(loop, picture)
            if options.json:
                write_json(options.json, summary)
            tell(summary, loop, picture, pictures, checkpoints, end)
    return 128 + end if isinstance(end, int) else 0


def settings_from(options: argparse.Namespace, scene: Scene) -> RenderSettings:
    """Raises BokehguideError for a value out of range."""
    names = ("mode", "spp", "seed", "device", "threads", "reuse_radius", "target_noise", "compile")
    crop = options.crop and crop_pixels(options.crop, scene.film)
    return RenderSettings(**{name: getattr(options, name) for name in names}, crop=crop)


def crop_pixels(box: tuple[float, ...], film: Film) -> tuple[int, int, int, int]:
    """The box in pixels: as it is, or, where it is at most 1 wide and high, as fractions of the frame."""
    if max(box[2:]) <= 1.0:
        rows, columns = Inset(*box).pixels(film.width, film.height)
        return columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start
    return tuple(int(value) for value in box)


def read_window(path: Path, scene: Scene, window: tuple[int, int, int, int]) -> Tensor:
    """What a reference of the whole frame shows in the window. Raises BokehguideError as `read_reference`."""
    left, top, width, height = window
    return read_reference(path, scene.film.width, scene.film.height)[top : top + height, left : left + width]


def overrides_from(options: argparse.Namespace) -> Overrides:
    """What the command line changes about the scene."""
    width, height = options.size or (None, None)
    return Overrides(width=width, height=height, **{name: getattr(options, name) for name in OVERRIDES})


def check_device(device: str) -> None:
    """Raise BokehguideError where torch has no such device here."""
    if device == "cuda" and not torch.cuda.is_available():
        raise BokehguideError("--device cuda: torch finds no CUDA device here; give --device cpu")


def check_outputs(out: Path, options: argparse.Namespace, log_folder: Path) -> None:
    """Raise BokehguideError where something that is to be written cannot be."""
    png, checkpoint = out.with_suffix(".png"), out.with_suffix(".ckpt")
    for option, path in (("--reference", options.reference), ("--json", options.json)):
        if path is not None and path.resolve() in (out.resolve(), png.resolve(), checkpoint.resolve()):
            raise BokehguideError(f"{option}: {str(path)!r} is where the render goes; give another path")
    if options.json and options.reference and options.json.resolve() == options.reference.resolve():
        raise BokehguideError(f"--json: {str(options.json)!r} is the reference; give another path")
    for path in (out, png, checkpoint):
        check_writable(path)
        remove_abandoned(path)
    if options.json:
        check_writable(options.json)
    if options.logdir:
        check_writable(log_folder / "events")


def tell(
    summary: dict,
    loop: RenderLoop | AdaptiveLoop,
    picture: RenderFilm,
    pictures: Pictures,
    checkpoints: Checkpoints,
    end: int | str | None,
) -> None:
    """Say how it went: on stdout what was made, on stderr what went wrong."""
    errors = f", MAPE {summary['mape']:.5f}, relMSE {summary['relmse']:.5f}" if "mape" in summary else ""
    if "estimated_mape" in summary:
        mean = summary["samples"] / (picture.width * picture.height)
        errors = f", {mean:.1f} a pixel, estimated MAPE {summary['estimated_mape']:.5f}{errors}"
    rate = summary["samples_per_second"] / 1e6
    print(f"{summary['spp']} SPP in {summary['seconds']:.1f} s, {rate:.2f} million samples/s{errors}")
    if isinstance(end, str):
        print(f"stopped: {end}")
    print(f"wrote {pictures.path} and {pictures.png}")
    kept = checkpoints.holds(loop)
    if kept:
        size = checkpoints.path.stat().st_size / 2**20
        print(f"wrote {checkpoints.path} ({size:.1f} MB), from which --resume goes on to more SPP")
    if picture.bad_count:
        bad = picture.bad_samples[0]
        print(
            f"bokehguide: warning: {picture.bad_count} NaN or infinite samples were left out; the first: "
            f"pixel ({bad.x}, {bad.y}), step {bad.step}, --seed {bad.seed}",
            file=sys.stderr,
        )
    if isinstance(end, int):
        saved = f"; saved, --resume goes on from {checkpoints.path}" if kept else ""
        print(f"bokehguide: interrupted at {loop.step_number} of {loop.settings.spp} SPP{saved}", file=sys.stderr)
