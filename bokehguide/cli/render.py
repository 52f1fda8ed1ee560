"""`bokehguide render`."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bokehguide.cli.checkpoints import Checkpoints
from bokehguide.cli.folders import make_folders, print_folders
from bokehguide.cli.inputs import refuse_scene_files
from bokehguide.cli.memory import check_memory, describe, explained
from bokehguide.cli.pictures import Pictures, chosen_exposure, warn_if_opaque
from bokehguide.cli.report import json_file, text_beside, write_json
from bokehguide.cli.sole_writer import sole_writer
from bokehguide.cli.steps import measure, take_steps
from bokehguide.cli.terminal import say
from bokehguide.cli.tev import TevViewer, require_client
from bokehguide.errors import BokehguideError
from bokehguide.image import Display, check_writable, remove_abandoned
from bokehguide.image.cryptomatte import require_hash
from bokehguide.image.oidn import require_denoiser
from bokehguide.metrics import read_reference
from bokehguide.render import Film
from bokehguide.render.halves_film import HalvesFilm
from bokehguide.runtime.device import check_device
from bokehguide.runtime.interrupt import Interrupt
from bokehguide.runtime.process import dedicate_process
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.scene.overrides import OVERRIDES
from bokehguide.train import LENS_MODES, MODES, AdaptiveLoop, Ranks, RenderLoop, RenderSettings, make_loop, restarts
from bokehguide.train.logger import run_folder
from bokehguide.train.settings import crop_pixels


def run(options: argparse.Namespace) -> int:
    """Render to an EXR and a PNG; all input is checked before the first ray."""
    dedicate_process()
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    settings = settings_from(options, scene)
    check_device(settings.device)
    if settings.denoise:
        require_denoiser()
    if settings.cryptomatte:
        require_hash()
    if options.tev:
        require_client()
    window = settings.window(scene.film.width, scene.film.height)
    reference = read_window(options.reference, scene, window) if options.reference else None
    out = options.out or Path(f"{scene.name}-{settings.mode}.exr")
    check_outputs(scene, out, options, run_folder(options.logdir or "", scene, settings))
    check_memory(scene, settings)
    with (
        Ranks.join(settings.device) as ranks,
        sole_writer(out) if ranks.first else nullcontext(),
        explained(describe(scene)),
    ):
        if ranks.first:
            print_warnings(scene)
        with make_loop(scene, settings, ranks) as loop:
            return render(loop, options, reference, out)


def render(loop: RenderLoop | AdaptiveLoop, options: argparse.Namespace, reference: Tensor | None, out: Path) -> int:
    """Render from the first step or from a checkpoint, and write the files; returns the exit code. Collective."""
    first = loop.ranks.first
    checkpoints = Checkpoints(out.with_suffix(".ckpt"), options.checkpoint_every, silent=not first)
    earlier = checkpoints.begin(loop, options.resume, restarts() > 0)
    display = Display(chosen_exposure(options.exposure, loop.scene.film.exposure), options.view)
    viewer = make_viewer(loop, options) if first and options.tev else None
    pictures = Pictures(out, options, display, viewer)
    with Interrupt(partial(tell_interruption, loop) if first else None) as interrupt:  # a signal ends the render in order
        end, report = take_steps(loop, options, reference, checkpoints, pictures, earlier, interrupt)
        with interrupt.saving():
            picture = loop.picture()
            write_pictures(loop, pictures, picture, checkpoints, report.seconds)
            if viewer:
                viewer.finish()
            if first:
                summary = report.finish(loop, picture, final_errors(pictures, options, reference))
                if not isinstance(end, int):
                    checkpoints.remove(loop)
                if options.json:
                    write_summary(options.json, summary | pictures.facts)
                with text_beside(options.json):
                    print_summary(summary, picture, end)
                    print(f"exposure {pictures.exposure:+g} EV{' (metered)' * (display.exposure is None)}, view {display.view}")
                    print_files(loop, pictures, checkpoints)
                print_problems(loop, picture, checkpoints, end)
                warn_if_opaque(pictures.alpha)
    number = end if isinstance(end, int) else interrupt.signal
    return 0 if number is None or loop.complete else 128 + number


def tell_interruption(loop: RenderLoop | AdaptiveLoop) -> None:
    """Tell on stderr what follows a first signal. A thread does, as the main thread may be using stderr at the signal."""
    work = "finishing the render" if loop.complete else "finishing the step and saving"
    text = f"{work}; a second interruption during the step discards the samples since the last save"
    threading.Thread(target=say, args=(text,)).start()


def make_viewer(loop: RenderLoop | AdaptiveLoop, options: argparse.Namespace) -> TevViewer:
    """The connection to tev that the options ask for."""
    *_, width, height = loop.settings.window(loop.camera.width, loop.camera.height)
    return TevViewer(options.tev, f"{loop.scene.name} {loop.settings.mode}", (width, height), options.denoise)


def write_pictures(
    loop: RenderLoop | AdaptiveLoop,
    pictures: Pictures,
    picture: Film | HalvesFilm,
    checkpoints: Checkpoints,
    seconds: float,
) -> None:
    """Write the images of the end; collective.

    Raises BokehguideError if they cannot be written. The state is saved then, so that no sample is lost.
    """
    failure = None
    if loop.ranks.first:
        try:
            pictures.write(loop, picture)
        except BokehguideError as error:
            failure = error
    (failed,) = loop.ranks.any(failure is not None)
    if failed:
        checkpoints.save(loop, seconds)
    if failure is not None:
        kept = f"\nThe samples are kept in {checkpoints.path}; --resume writes the picture" if checkpoints.holds(loop) else ""
        raise BokehguideError(f"{failure}{kept}") from failure


def write_summary(path: Path | str, summary: dict[str, Any]) -> None:
    """Write the summary as JSON. Warns if it cannot be written, as the picture is there."""
    try:
        write_json(path, summary)
    except BokehguideError as error:
        say(f"warning: {error}")


def final_errors(pictures: Pictures, options: argparse.Namespace, reference: Tensor | None) -> dict[str, float]:
    """Errors of the delivered picture by name: against the reference, and estimated where an option is about errors."""
    errors = {} if reference is None else measure(torch.as_tensor(pictures.delivered), reference)
    asked = options.target_noise is not None or options.time_limit is not None or options.denoise
    if asked and pictures.estimated_mape is not None:
        errors |= {"estimated_mape": pictures.estimated_mape}
    return errors


def settings_from(options: argparse.Namespace, scene: Scene) -> RenderSettings:
    """The settings of the command line. Raises BokehguideError for a value out of range."""
    names = ("mode", "spp", "seed", "device", "threads", "target_noise", "denoise", "cryptomatte", "light_groups")
    crop = options.crop and crop_pixels(options.crop, scene.film.width, scene.film.height)
    settings = RenderSettings(**{name: getattr(options, name) for name in names}, crop=crop)
    return with_reuse_radius([settings], options.reuse_radius)[0]


def with_reuse_radius(every: Sequence[RenderSettings], radius: float | None) -> list[RenderSettings]:
    """The settings with a radius, or as they are without one. Raises BokehguideError where no mode uses the radius."""
    if radius is None:
        return list(every)
    changed = [replace(settings, reuse_radius=radius) for settings in every]
    if not any(settings.whole_frame for settings in every):
        users = " or ".join(mode for mode in MODES if mode not in LENS_MODES)
        named = ", ".join(settings.mode for settings in every)
        raise BokehguideError(f"--reuse-radius: {radius:g} has no effect in {named}; leave it out, or choose {users}")
    return changed


def read_window(path: Path, scene: Scene, window: tuple[int, int, int, int]) -> Tensor:
    """The window (left, top, width, height) of a reference of the frame. Raises BokehguideError as `read_reference`."""
    left, top, width, height = window
    return read_reference(path, scene.film.width, scene.film.height)[top : top + height, left : left + width]


def overrides_from(options: argparse.Namespace) -> Overrides:
    """The overrides of the scene on the command line."""
    width, height = options.size or (None, None)
    return Overrides(width=width, height=height, **{name: getattr(options, name) for name in OVERRIDES})


def check_outputs(scene: Scene, out: Path, options: argparse.Namespace, log_folder: Path) -> None:
    """Raise BokehguideError if an output cannot be written or is an input."""
    png, checkpoint, json = out.with_suffix(".png"), out.with_suffix(".ckpt"), json_file(options.json)
    for option, path in (("--reference", options.reference), ("--json", json)):
        if path is not None and path.resolve() in (out.resolve(), png.resolve(), checkpoint.resolve()):
            raise BokehguideError(f"{option}: {str(path)!r} is an output of this command; give another path")
    if json and options.reference and json.resolve() == options.reference.resolve():
        raise BokehguideError(f"--json: {str(json)!r} is the reference; give another path")
    refuse_scene_files(scene, [("--out", out), ("--out", png), ("--out", checkpoint), ("--json", json)])
    created = make_folders([path.parent for path in (out, json) if path] + ([options.logdir] if options.logdir else []))
    for path in (out, png, checkpoint):
        check_writable(path)
        remove_abandoned(path)
    if json:
        check_writable(json)
    if options.logdir:
        check_writable(log_folder / "events")
    print_folders(created)


def print_warnings(scene: Scene) -> None:
    """Print the warnings of the scene's files and its likely mistakes on stderr."""
    for warning in (*scene.warnings, *scene.likely_mistakes):
        say(f"warning: {warning}")


def print_summary(summary: dict[str, Any], picture: Film | HalvesFilm, end: int | str | None) -> None:
    """Print SPP, time, speed and errors, and the reason of an early end."""
    errors = f", MAPE {summary['mape']:.5f}, relMSE {summary['relmse']:.5f}" if "mape" in summary else ""
    if "estimated_mape" in summary:
        mean = summary["samples"] / (picture.width * picture.height)
        per_pixel = f", {mean:.1f} per pixel" if mean != summary["spp"] else ""
        errors = f"{per_pixel}, estimated MAPE {summary['estimated_mape']:.5f}{errors}"
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
