"""Several modes on one scene against one reference."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bokehguide import __version__
from bokehguide.evaluation.references import Reference
from bokehguide.evaluation.regions import MEASURES, MeanRatio, mean_ratio, regions
from bokehguide.evaluation.runs import Run, kept_picture, measured_run, read_runs, run_fingerprint
from bokehguide.image import Display, read_exr, write_text
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Scene
from bokehguide.train import MODES, RenderSettings

METRICS = "metrics.json"
SEED = 4_000_000
"""Seed of all compared renders; no chunk of a reference has it, and `render` does not use it by default."""
TINY = 1e-30
"""Replaces an error of 0, which has no logarithm."""


@dataclass(frozen=True)
class Comparison:
    """Runs and images (radiance, float32 `[H, W, 3]`) by mode, in the order of the table."""

    scene: Scene
    settings: RenderSettings
    reference: Reference
    runs: Mapping[str, Run]
    images: Mapping[str, Tensor]
    over_uniform: Mapping[str, MeanRatio]
    """Ratio of the reference's mean luminance to that of mode uniform by region; empty without this mode. A bias of the
    reference's guided mode is common to both of its halves, and shows only here."""

    @property
    def equal_rays(self) -> int:
        """Fewest rays of a finished render."""
        return min(run.rays[-1] for run in self.runs.values())

    @property
    def equal_seconds(self) -> float:
        """Fewest seconds of a finished render."""
        return min(run.seconds[-1] for run in self.runs.values())


def compare(
    scene: Scene, every: Sequence[RenderSettings], reference: Reference, folder: Path, display: Display = Display()
) -> Comparison:
    """Render the modes that `folder` lacks, and keep each there as soon as it is finished.

    every: settings of the modes, in the order of the table, equal but for the mode; display: of the images, which share
    the exposure that suits the reference. A mode of an
    earlier call is kept if its inputs and its SPP are the same: a guided render cannot be continued without the state of its
    guide. Runs of other modes stay in `metrics.json` while they are comparable. One line on stdout reports each mode that is
    kept or rendered again.

    Raises BokehguideError if a file cannot be written, or as `read_runs` does.
    """
    display = display.metered(reference.radiance)
    found = read_runs(folder / METRICS)
    runs = {mode: run for mode, run in found.items() if is_current(mode, run, scene, every[0], reference)}
    images = {mode: image for mode, run in runs.items() if (image := kept_picture(folder, mode, run)) is not None}
    for settings in every:
        mode = settings.mode
        if mode in images:
            print(f"{mode}: kept, {settings.spp} SPP")
            continue
        if mode in found:
            print(f"{mode}: rendered again, {why_again(found[mode], mode in runs, settings.spp)}")
        runs[mode], images[mode] = measured_run(scene, settings, reference, folder, display)
        write_metrics(folder, shown(scene, every, reference, runs, images, folder), runs)
    comparison = shown(scene, every, reference, runs, images, folder)
    write_metrics(folder, comparison, runs)
    return comparison


def is_current(mode: str, run: Run, scene: Scene, settings: RenderSettings, reference: Reference) -> bool:
    """Whether a render of `mode` with these settings would give this run again."""
    if run.spp != settings.spp or mode not in MODES:
        return False
    return run.run_fingerprint == run_fingerprint(scene, replace(settings, mode=mode), reference)


def why_again(run: Run, current: bool, spp: int) -> str:
    """The reason why a mode is rendered again."""
    if run.spp != spp:
        return f"as it has {run.spp} SPP and cannot be continued exactly"
    if current:
        return "as its image is missing or damaged"
    return "as the scene, the reference, the insets or the settings have changed"


def shown(
    scene: Scene,
    every: Sequence[RenderSettings],
    reference: Reference,
    runs: Mapping[str, Run],
    images: Mapping[str, Tensor],
    folder: Path,
) -> Comparison:
    """The comparison of the finished modes."""
    done = [settings.mode for settings in every if settings.mode in images]
    done_runs, done_images = {mode: runs[mode] for mode in done}, {mode: images[mode] for mode in done}
    over_uniform = cross_check(scene, reference, folder / "uniform.exr") if "uniform" in done else {}
    return Comparison(scene, every[0], reference, done_runs, done_images, over_uniform)


def cross_check(scene: Scene, reference: Reference, path: Path) -> dict[str, MeanRatio]:
    """Ratio of the reference's mean luminance to that of the uniform render in an EXR, by region."""
    channels = {name: torch.from_numpy(plane) for name, plane in read_exr(path).items()}
    light = luminance(torch.stack([channels[name] for name in "RGB"]))
    expected = luminance(reference.radiance.movedim(-1, 0))
    masks = regions(scene)
    return {name: mean_ratio(expected[mask], light[mask], channels["variance.Y"][mask]) for name, mask in masks.items()}


def write_metrics(folder: Path, comparison: Comparison, runs: Mapping[str, Run]) -> None:
    """Write `metrics.json`: the comparison, and all runs that are comparable with it."""
    scene, settings = comparison.scene, comparison.settings
    facts = {
        "scene": scene.name,
        "size": f"{scene.film.width}x{scene.film.height}",
        "spp": settings.spp,
        "seed": settings.seed,
        "device": settings.device,
        "threads": settings.threads,
        "reuse_radius": settings.reuse_radius,
        "software": f"bokehguide {__version__}",
        "insets": [asdict(inset) for inset in scene.insets],
        "reference": comparison.reference.facts(),
        "reference_over_uniform": {region: ratio._asdict() for region, ratio in comparison.over_uniform.items()},
        **summary(comparison),
        "runs": {mode: asdict(run) for mode, run in runs.items()},
    }
    write_text(folder / METRICS, json.dumps(facts, indent=1) + "\n")


def summary(comparison: Comparison) -> dict[str, Any]:
    """The comparison in numbers, ready for JSON: the budgets, and costs and errors of each mode at the budgets and at the end."""
    rays, seconds = comparison.equal_rays, comparison.equal_seconds
    modes = {}
    for mode, run in comparison.runs.items():
        modes[mode] = {
            "spp": run.spp,
            "seconds": run.seconds[-1],
            "rays": run.rays[-1],
            **errors_at(run, run.rays, run.rays[-1]),
            "at_equal_rays": errors_at(run, run.rays, rays),
            "at_equal_time": errors_at(run, run.seconds, seconds),
        }
    return {"equal_rays": rays, "equal_seconds": seconds, "modes": modes}


def errors_at(run: Run, cost: Sequence[float], budget: float) -> dict[str, dict[str, float | None]]:
    """Errors by measure and region at `budget`. cost: `seconds` or `rays` of the run."""
    return {
        measure: {region: interpolated(cost, run.errors[region][measure], budget) for region in run.errors}
        for measure in MEASURES
    }


def interpolated(cost: Sequence[float], error: Sequence[float], budget: float) -> float | None:
    """A curve at `budget`, linear between its points in log-log; None before the first point.

    cost: increasing; budget: at most the last cost.
    """
    if budget < cost[0]:
        return None
    logs = np.log(cost), np.log(np.maximum(error, TINY))
    return float(np.exp(np.interp(np.log(budget), *logs)))
