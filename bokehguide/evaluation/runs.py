"""One mode's render, measured after every step."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from bokehguide import __version__
from bokehguide.errors import BokehguideError
from bokehguide.evaluation.fingerprint import fingerprint
from bokehguide.evaluation.long_renders import progress, warn_of_bad_samples, whole_step
from bokehguide.evaluation.references import Reference
from bokehguide.evaluation.regions import MEASURES, errors, regions
from bokehguide.image import read_metadata, read_rgb, tone_map, write_exr, write_png
from bokehguide.scene.digest import digest
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLogger, RenderLoop, RenderSettings, describe_render


@dataclass(frozen=True)
class Run:
    """What was measured of one render; every sequence has one value a step, that is, an SPP.

    origin: digest of what it was made from; seconds, rays: of all steps so far;
    errors: by region (see `regions`) and measure (MEASURES).
    """

    origin: str
    seconds: Sequence[float]
    rays: Sequence[int]
    errors: dict[str, dict[str, Sequence[float]]]

    @property
    def spp(self) -> int:
        return len(self.seconds)


def origin(scene: Scene, settings: RenderSettings, reference: Reference) -> str:
    """A digest of all that a run depends on but its SPP: two runs with the same one may be compared."""
    radius = settings.reuse_radius if settings.reuses else RenderSettings.reuse_radius
    rest = (replace(settings, spp=1, reuse_radius=radius), __version__, scene.insets, reference.radiance.numpy())
    return digest((fingerprint(scene, settings), *rest))


def measured_run(
    scene: Scene, settings: RenderSettings, reference: Reference, folder: Path, exposure: float
) -> tuple[Run, Tensor]:
    """Render one mode and measure it step by step; gives its radiance `[H, W, 3]` too.

    Writes MODE.exr and MODE.png into `folder`, and TensorBoard logs into its folder `logs`. The
    seconds are those of the steps alone: building the scene, measuring and logging are left out.
    """
    RenderLoop(scene, settings).step()  # so that no mode pays for what a first step loads
    loop = RenderLoop(scene, settings)
    logger = RenderLogger(folder / "logs", scene, settings, exposure)
    masks = regions(scene)
    seconds, rays = [], []
    history = {region: {measure: [] for measure in MEASURES} for region in masks}
    title = f"{scene.name} {settings.mode}"
    with progress(title, settings.spp) as bar:
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
    run = Run(origin(scene, settings, reference), seconds, rays, history)
    facts = describe_render(scene, settings, settings.spp) | {"origin": run.origin}
    write_exr(folder / f"{settings.mode}.exr", loop.film.layers(), facts)
    write_png(folder / f"{settings.mode}.png", tone_map(radiance, exposure))
    return run, radiance


def kept_picture(folder: Path, mode: str, run: Run) -> Tensor | None:
    """Radiance `[H, W, 3]` that was kept with this run, or None where there is none, or none that can be read."""
    path = folder / f"{mode}.exr"
    try:
        facts, radiance = read_metadata(path), torch.from_numpy(read_rgb(path))
    except BokehguideError:
        return None
    return radiance if (facts.get("origin"), facts.get("spp")) == (run.origin, run.spp) else None


def read_runs(path: Path) -> dict[str, Run]:
    """The runs by mode in a `metrics.json`; none where there is no such file.

    Raises BokehguideError where the file cannot be read or is not one that `compare` wrote.
    """
    if not path.exists():
        return {}
    try:
        return {str(mode): _read_run(facts) for mode, facts in json.loads(path.read_bytes())["runs"].items()}
    except OSError as error:
        raise BokehguideError(f"{path}: cannot be read ({error.strerror}); choose another folder") from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BokehguideError(f"{path}: is damaged or no comparison's; remove it or choose another folder") from error


def _read_run(facts: dict) -> Run:
    """Raises what `read_runs` catches for anything that is not the JSON of a run."""
    run = Run(**facts)
    curves = [run.seconds, run.rays, *(curve for by_measure in run.errors.values() for curve in by_measure.values())]
    if not isinstance(run.origin, str) or "frame" not in run.errors or run.spp == 0:
        raise ValueError("not a run")
    for curve in curves:
        if len(curve) != run.spp or not all(math.isfinite(value) for value in curve):
            raise ValueError("not a run's curve")
    if any(by_measure.keys() != set(MEASURES) for by_measure in run.errors.values()):
        raise ValueError("not a run's errors")
    return run
