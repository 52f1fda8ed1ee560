"""`bokehguide render`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

import torch
from torch import Tensor

from bokehguide.cli.checkpoints import Checkpoints
from bokehguide.cli.report import Report, write_json
from bokehguide.errors import BokehguideError
from bokehguide.image import check_writable, remove_abandoned, tone_map, write_exr, write_png
from bokehguide.interrupt import Interrupt
from bokehguide.metrics import mape, read_reference, relmse
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import RenderLogger, RenderLoop, RenderSettings, describe_render
from bokehguide.train.logger import run_folder

OVERRIDES = ("environment", "f_number", "aperture_radius", "focus_distance", "camera_position", "camera_target", "fov", "camera")


def run(options: argparse.Namespace) -> int:
    """Render to an EXR and a PNG; everything that can be wrong is checked before the first ray."""
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    settings = RenderSettings(
        mode=options.mode,
        spp=options.spp,
        seed=options.seed,
        device=options.device,
        threads=options.threads,
        reuse_radius=options.reuse_radius,
    )
    check_device(settings.device)
    reference = read_reference(options.reference, scene.film.width, scene.film.height) if options.reference else None
    out = options.out or Path(f"{scene.name}-{settings.mode}.exr")
    check_outputs(out, options, run_folder(options.logdir or "", scene, settings))
    for warning in scene.warnings:
        print(f"bokehguide: warning: {warning}", file=sys.stderr)

    loop = RenderLoop(scene, settings)
    checkpoints = Checkpoints(out.with_suffix(".ckpt"), options.checkpoint_every)
    earlier = checkpoints.begin(loop, options.resume)
    done = loop.step_number
    logger = RenderLogger(options.logdir, scene, settings, options.exposure, done) if options.logdir else None
    with Interrupt() as interrupt:
        report = Report(f"{scene.name} {settings.mode}", settings, done, earlier)
        while loop.step_number < settings.spp:
            stats = loop.step()
            errors = measure(loop.film.radiance(), reference)
            report.add(stats, errors)
            if logger:
                logger.log(loop, stats, errors)
            if checkpoints.due():
                if logger:
                    logger.flush()  # or what is saved could be missing in the log
                checkpoints.save(loop, report.seconds)
            if interrupt.requested:
                break
        checkpoints.save(loop, report.seconds)

    if logger:
        logger.finish(loop, loop.step_number)
    write_pictures(out, loop, options)
    summary = report.finish(loop, measure(loop.film.radiance(), reference))
    if options.json:
        write_json(options.json, summary)
    tell(summary, loop, out, checkpoints)
    return 128 + interrupt.signal if interrupt.requested else 0


def write_pictures(out: Path, loop: RenderLoop, options: argparse.Namespace) -> None:
    """The EXR with what it was made from, and the PNG beside it."""
    facts = describe_render(loop.scene, loop.settings, loop.step_number)
    write_exr(out, loop.film.layers(), facts | {"command": command_line(options, loop.step_number)})
    write_png(out.with_suffix(".png"), tone_map(loop.film.radiance(), options.exposure))


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


def measure(radiance: Tensor, reference: Tensor | None) -> dict[str, float]:
    """MAPE and relMSE, or nothing where there is no reference."""
    if reference is None:
        return {}
    radiance = radiance.cpu()
    return {"mape": mape(radiance, reference), "relmse": relmse(radiance, reference)}


def command_line(options: argparse.Namespace, spp: int) -> str:
    """The command that renders this picture again."""
    size = {"size": "x".join(map(str, options.size))} if options.size else {}
    kept = {name: getattr(options, name) for name in ("mode", "reuse_radius", "seed", "device", "exposure", *OVERRIDES)}
    words = ["bokehguide", "render", options.scene]
    for name, value in (kept | size | {"spp": spp}).items():
        if value is not None:
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            words.append(f"--{name.replace('_', '-')}={text}")
    return shlex.join(words + ["--allow-outside"] * options.allow_outside)


def tell(summary: dict, loop: RenderLoop, out: Path, checkpoints: Checkpoints) -> None:
    """Say how it went: on stdout what was made, on stderr what went wrong."""
    errors = f", MAPE {summary['mape']:.5f}, relMSE {summary['relmse']:.5f}" if "mape" in summary else ""
    rate = summary["samples_per_second"] / 1e6
    print(f"{summary['spp']} SPP in {summary['seconds']:.1f} s, {rate:.2f} million samples/s{errors}")
    print(f"wrote {out} and {out.with_suffix('.png')}")
    kept = checkpoints.holds(loop)
    if kept:
        size = checkpoints.path.stat().st_size / 2**20
        print(f"wrote {checkpoints.path} ({size:.1f} MB), from which --resume goes on to more SPP")
    if loop.film.bad_count:
        bad = loop.film.bad_samples[0]
        print(
            f"bokehguide: warning: {loop.film.bad_count} NaN or infinite samples were left out; the first: "
            f"pixel ({bad.x}, {bad.y}), step {bad.step}, --seed {bad.seed}",
            file=sys.stderr,
        )
    if loop.step_number < loop.settings.spp:
        saved = f"; saved, --resume goes on from {checkpoints.path}" if kept else ""
        print(f"bokehguide: interrupted at {loop.step_number} of {loop.settings.spp} SPP{saved}", file=sys.stderr)
