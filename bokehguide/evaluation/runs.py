"""One mode's render, measured after every step."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from bokehguide import __version__
from bokehguide.errors import BokehguideError
from bokehguide.evaluation.fingerprint import fingerprint
from bokehguide.evaluation.long_renders import warn_of_bad_samples, whole_step
from bokehguide.evaluation.references import Reference
from bokehguide.evaluation.regions import MEASURES, errors, regions
from bokehguide.image import Display, read_metadata, read_rgb, write_exr, write_png
from bokehguide.runtime.bars import progress
from bokehguide.scene.digest import digest
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLogger, RenderLoop, RenderSettings, describe_render


@dataclass(frozen=True)
class Run:
    """Measurements of one render; every sequence has one value per step, that is, per SPP.

    run_fingerprint: digest of the inputs; seconds, rays: of all steps so far; errors: by region (see `regions`) and measure
    (MEASURES).
    """

    run_fingerprint: str
    seconds: Sequence[float]
    rays: Sequence[int]
    errors: Mapping[str, Mapping[str, Sequence[float]]]

    @property
    def spp(self) -> int:
        return len(self.seconds)


def run_fingerprint(scene: Scene, settings: RenderSettings, reference: Reference) -> str:
    """A digest of all that a run depends on but its SPP: two runs with the same one may be compared."""
    radius = settings.reuse_radius if settings.whole_frame else RenderSettings.reuse_radius
    rest = (replace(settings, spp=1, reuse_radius=radius), __version__, scene.insets, reference.radiance.numpy())
    return digest((fingerprint(scene, settings), *rest))


def measured_run(
    scene: Scene, settings: RenderSettings, reference: Reference, folder: Path, display: Display
) -> tuple[Run, Tensor]:
    """Render one mode and measure it after every step; returns its radiance `[H, W, 3]` too.

    Writes MODE.exr and MODE.png into `folder`, and TensorBoard logs into its folder `logs`. Seconds are those of the steps
    alone, without building the scene, measuring and logging.
    """
    with RenderLoop(scene, settings) as trial:
        trial.step()  # the first step of a process loads libraries, which no mode should pay for
    logger = RenderLogger(folder / "logs", scene, settings, display)
    masks = regions(scene)
    seconds: list[float] = []
    rays: list[int] = []
    history: dict[str, dict[str, list[float]]] = {region: {measure: [] for measure in MEASURES} for region in masks}
    title = f"{scene.name} {settings.mode}"
    with progress(title, settings.spp) as bar, RenderLoop(scene, settings) as loop:
        for _ in range(settings.spp):
            stats = whole_step(loop)
            seconds.append(stats.seconds + (seconds[-1] if seconds else 0.0))
            rays.append(stats.rays + (rays[-1] if rays else 0))
            radiance, found = loop.film.radiance().cpu(), {}
            for region, mask in masks.items():
                for measure, value in errors(radiance, reference.radiance, mask).items():
                    history[region][measure].append(value)
                    found[measure if region == "frame" else f"{measure}_{region}"] = value
            logger.log(loop, stats, found, loop.film)
            bar.set_postfix_str(f"MAPE {found['mape']:.4f}", refresh=False)
            bar.update()
    logger.finish(loop, settings.spp, loop.film)
    warn_of_bad_samples(loop.film, title)
    run = Run(run_fingerprint(scene, settings, reference), seconds, rays, history)
    facts = describe_render(scene, settings, settings.spp) | {"run_fingerprint": run.run_fingerprint}
    write_exr(folder / f"{settings.mode}.exr", loop.film.layers(), facts)
    radiance = loop.film.radiance().cpu()
    write_png(folder / f"{settings.mode}.png", display.show(radiance))
    return run, radiance


def kept_picture(folder: Path, mode: str, run: Run) -> Tensor | None:
    """Radiance `[H, W, 3]` kept with this run, or None if its file is missing, damaged or of another run."""
    path = folder / f"{mode}.exr"
    try:
        facts, radiance = read_metadata(path), torch.from_numpy(read_rgb(path))
    except BokehguideError:
        return None
    return radiance if (facts.get("run_fingerprint"), facts.get("spp")) == (run.run_fingerprint, run.spp) else None


def read_runs(path: Path) -> dict[str, Run]:
    """The runs by mode in a `metrics.json`; empty if there is no such file.

    Raises BokehguideError if the file cannot be read or `compare` did not write it.
    """
    if not path.exists():
        return {}
    try:
        return {str(mode): _read_run(facts) for mode, facts in json.loads(path.read_bytes())["runs"].items()}
    except OSError as error:
        raise BokehguideError(f"{path}: cannot be read ({error.strerror}); choose another folder") from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BokehguideError(f"{path}: is damaged or no file of `compare`; remove it or choose another folder") from error


def _read_run(facts: dict) -> Run:
    """A run from its JSON. Raises an exception that `read_runs` catches for anything else."""
    run = Run(**facts)
    curves = [run.seconds, run.rays, *(curve for by_measure in run.errors.values() for curve in by_measure.values())]
    if not isinstance(run.run_fingerprint, str) or "frame" not in run.errors or run.spp == 0:
        raise ValueError("not a run")
    for curve in curves:
        if len(curve) != run.spp or not all(math.isfinite(value) for value in curve):
            raise ValueError("not a run's curve")
    if any(by_measure.keys() != set(MEASURES) for by_measure in run.errors.values()):
        raise ValueError("not a run's errors")
    return run
