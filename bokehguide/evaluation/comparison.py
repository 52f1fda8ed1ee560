"""Several modes on one scene against one reference."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bokehguide import __version__
from bokehguide.evaluation.references import Reference
from bokehguide.evaluation.regions import MEASURES, MeanRatio, mean_ratio, regions
from bokehguide.evaluation.runs import Run, kept_picture, measured_run, origin, read_runs
from bokehguide.image import read_exr, replacing
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Scene
from bokehguide.train import MODES, RenderSettings

METRICS = "metrics.json"
SEED = 4_000_000
"""Of all renders that are compared; no reference's chunks have it, nor a plain `render`."""
TINY = 1e-30
"""Stands in for an error of 0, which has no logarithm."""


@dataclass(frozen=True)
class Comparison:
    """Runs and pictures (radiance, float32 `[H, W, 3]`) by mode, in the order in which they are shown."""

    scene: Scene
    settings: RenderSettings
    reference: Reference
    runs: Mapping[str, Run]
    images: Mapping[str, Tensor]
    over_uniform: Mapping[str, MeanRatio]
    """The reference's mean luminance over that of mode uniform by region, where that is among the modes: a reference
    is rendered in a guided mode, and its two halves would share what is wrong with that."""

    @property
    def equal_rays(self) -> int:
        """Rays of the whole render that traced the fewest."""
        return min(run.rays[-1] for run in self.runs.values())

    @property
    def equal_seconds(self) -> float:
        """Seconds of the whole render that took the least."""
        return min(run.seconds[-1] for run in self.runs.values())


def compare(
    scene: Scene, every: Sequence[RenderSettings], reference: Reference, folder: Path, exposure: float = 0.0
) -> Comparison:
    """Render the modes that `folder` does not hold yet, and keep each there as soon as it is done.

    every: settings of the modes, in the order in which they are shown; they differ in nothing
    else. A mode is kept from an earlier call where all that it depends on is the same, its
    SPP too: a guided render cannot be continued without the state of its guide. Runs of other
    modes stay in `metrics.json` as long as they may be compared with these. A line on stdout
    tells what becomes of each mode. exposure: EV of the pictures.

    Raises BokehguideError where something cannot be written, or as `read_runs` does.
    """
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
        runs[mode], images[mode] = measured_run(scene, settings, reference, folder, exposure)
        write_metrics(folder, shown(scene, every, reference, runs, images, folder), runs)
    comparison = shown(scene, every, reference, runs, images, folder)
    write_metrics(folder, comparison, runs)
    return comparison


def is_current(mode: str, run: Run, scene: Scene, settings: RenderSettings, reference: Reference) -> bool:
    """Whether rendering `mode` with these settings would measure the same again."""
    if run.spp != settings.spp or mode not in MODES:
        return False
    return run.origin == origin(scene, replace(settings, mode=mode), reference)


def why_again(run: Run, current: bool, spp: int) -> str:
    if run.spp != spp:
        return f"as it has {run.spp} SPP and cannot be continued exactly"
    if current:
        return "as its picture is gone or damaged"
    return "as the scene, the reference, the insets or the settings have changed"


def shown(
    scene: Scene,
    every: Sequence[RenderSettings],
    reference: Reference,
    runs: Mapping[str, Run],
    images: Mapping[str, Tensor],
    folder: Path,
) -> Comparison:
    """The comparison of those of the modes that are done."""
    done = [settings.mode for settings in every if settings.mode in images]
    pick = ({mode: found[mode] for mode in done} for found in (runs, images))
    over_uniform = cross_check(scene, reference, folder / "uniform.exr") if "uniform" in done else {}
    return Comparison(scene, every[0], reference, *pick, over_uniform)


def cross_check(scene: Scene, reference: Reference, path: Path) -> dict[str, MeanRatio]:
    """The reference's mean luminance by region over that of the uniform render in an EXR."""
    channels = {name: torch.from_numpy(plane) for name, plane in read_exr(path).items()}
    light = luminance(torch.stack([channels[name] for name in "RGB"]))
    expected = luminance(reference.radiance.movedim(-1, 0))
    masks = regions(scene)
    return {name: mean_ratio(expected[mask], light[mask], channels["variance.Y"][mask]) for name, mask in masks.items()}


def write_metrics(folder: Path, comparison: Comparison, runs: Mapping[str, Run]) -> None:
    """Write `metrics.json`: what the comparison says, and all runs that may be compared with it."""
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
    with replacing(folder / METRICS) as temporary:
        temporary.write_text(json.dumps(facts, indent=1) + "\n")


def summary(comparison: Comparison) -> dict[str, object]:
    """The comparison in numbers, ready for JSON: the budgets, and each mode's costs and errors at them and at the end."""
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
    """Errors by measure and region once `cost`, one of the run's sequences, has reached `budget`."""
    return {
        measure: {region: interpolated(cost, run.errors[region][measure], budget) for region in run.errors}
        for measure in MEASURES
    }


def interpolated(cost: Sequence[float], error: Sequence[float], budget: float) -> float | None:
    """A curve at `budget`, linear between its points in log-log; None before the first one.

    cost: increasing; budget: at most the last cost.
    """
    if budget < cost[0]:
        return None
    logs = np.log(cost), np.log(np.maximum(error, TINY))
    return float(np.exp(np.interp(np.log(budget), *logs)))
