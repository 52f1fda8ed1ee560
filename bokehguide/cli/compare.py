"""`bokehguide compare`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

from bokehguide.cli.folders import make_folders, print_folders
from bokehguide.cli.inputs import refuse_scene_files
from bokehguide.cli.pictures import chosen_exposure
from bokehguide.cli.render import overrides_from, print_warnings, with_reuse_radius
from bokehguide.cli.terminal import clear_stage
from bokehguide.errors import BokehguideError
from bokehguide.evaluation import compare, given_reference, made_reference, report
from bokehguide.evaluation.comparison import METRICS, SEED
from bokehguide.evaluation.crops_figure import write_crops
from bokehguide.evaluation.curves_figure import write_convergence
from bokehguide.evaluation.references import Reference, half_files
from bokehguide.evaluation.runs import read_runs
from bokehguide.evaluation.tables import describe_reference
from bokehguide.image import Display, check_writable, write_text
from bokehguide.runtime.device import check_device
from bokehguide.runtime.process import dedicate_process
from bokehguide.scene import Inset, Scene, load_scene
from bokehguide.stopping import note_at_stop
from bokehguide.train import RenderSettings
from bokehguide.train.logger import run_folder

REFERENCE, TABLE, CURVES, CROPS = "reference.exr", "table.md", "convergence.png", "insets.png"
REFERENCE_SHARE = 16
"""SPP of the reference per SPP of a mode: its error is then a quarter of the error of its own mode."""


def run(options: argparse.Namespace) -> int:
    """Compare modes on a scene; all input is checked before the first ray."""
    dedicate_process()
    if options.cache and options.reference:
        raise BokehguideError(f"--cache: {str(options.cache)!r} has no effect with --reference; leave one of them out")
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    if options.inset:
        scene = replace(scene, insets=tuple(Inset(*box) for box in options.inset))
    common = {"spp": options.spp, "seed": SEED, "device": options.device, "threads": options.threads}
    every = with_reuse_radius([RenderSettings(mode, **common) for mode in options.modes], options.reuse_radius)
    display = Display(chosen_exposure(options.exposure, scene.film.exposure), options.view)
    check_device(options.device)
    reference = given_reference(options.reference, scene) if options.reference else None
    read_runs(options.out / METRICS)
    created = make_folders([options.out])
    check_outputs(scene, every, options)
    print_warnings(scene)
    kept = "finished modes" if options.reference else "samples of the reference and finished modes"
    note_at_stop(f"{kept} are kept; the same command continues")
    if reference is None:
        spp = options.reference_spp or REFERENCE_SHARE * options.spp
        reference = cached_reference(scene, replace(every[0], spp=spp), options)
    clear_stage()
    print_folders(created)
    print(describe_reference(reference), flush=True)
    comparison = compare(scene, every, reference, options.out, display)
    text = report(comparison)
    write_text(options.out / TABLE, text + "\n")
    write_convergence(options.out / CURVES, comparison)
    write_crops(options.out / CROPS, [comparison], display)
    print(f"\n{text}\n\nwrote {METRICS}, {TABLE}, {CURVES}, {CROPS}, the images and logs into {options.out}")
    return 0


def cached_reference(scene: Scene, settings: RenderSettings, options: argparse.Namespace) -> Reference:
    """A reference from the halves in the cache. Raises BokehguideError, with the option, if the cache cannot be written."""
    try:
        return made_reference(scene, settings, options.out / REFERENCE, options.cache)
    except BokehguideError as error:
        cached = str(error).startswith(tuple(map(str, half_files(scene, options.cache))))
        if cached and "cannot be written" in str(error):
            raise BokehguideError(f"{error} for references, with --cache") from error
        raise


def check_outputs(scene: Scene, every: Sequence[RenderSettings], options: argparse.Namespace) -> None:
    """Raise BokehguideError if an output cannot be written or is an input."""
    pictures = [f"{settings.mode}.{kind}" for settings in every for kind in ("exr", "png")]
    made = [] if options.reference else [REFERENCE]
    outputs = [options.out / name for name in (METRICS, TABLE, CURVES, CROPS, *made, *pictures)]
    if options.reference and options.reference.resolve() in [output.resolve() for output in outputs]:
        raise BokehguideError(f"--reference: {str(options.reference)!r} is an output of this command; give another path")
    refuse_scene_files(scene, [("--out", output) for output in outputs])
    logs = [run_folder(options.out / "logs", scene, settings) / "events" for settings in every]
    for path in (*outputs, *logs):
        check_writable(path)
