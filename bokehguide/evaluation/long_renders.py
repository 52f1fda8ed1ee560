"""Long renders that may be stopped and continued.

A long render is the mean of many short, independent ones ("chunks"), each with a seed of its
own. It is kept in an EXR after every chunk, so that the same command goes on where it ended.
The file knows the scene, mode and seed it was made from, not the version of the path tracer:
remove it where that has changed.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from bokehguide.errors import BokehguideError
from bokehguide.evaluation.fingerprint import fingerprint
from bokehguide.image import check_writable, read_exr, read_metadata, write_exr
from bokehguide.interrupt import Interrupt
from bokehguide.render.film import Film
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLoop, RenderSettings, StepStats


@dataclass(frozen=True)
class LongRender:
    """A mean of independent renders.

    radiance: `[H, W, 3]`; variance: of the luminance of `radiance`, `[H, W]`, both float64;
    spp: samples a pixel so far; chunks: renders so far.
    """

    radiance: Tensor
    variance: Tensor
    spp: int = 0
    chunks: int = 0

    def plus(self, film: Film, spp: int) -> LongRender:
        """This render and another one of `spp` samples, each weighed by its samples."""
        total = self.spp + spp
        radiance = (self.spp * self.radiance + spp * film.radiance().cpu()) / total
        variance = (self.spp**2 * self.variance + spp**2 * film.variance().cpu()) / total**2
        return LongRender(radiance, variance, total, self.chunks + 1)


def render(scene: Scene, settings: RenderSettings, bar: tqdm) -> Film:
    """The film of one whole render."""
    loop = RenderLoop(scene, settings)
    for _ in range(settings.spp):
        whole_step(loop)
        bar.update()
    return loop.film


def whole_step(loop: RenderLoop) -> StepStats:
    """One step of a render; Ctrl-C during it counts after it, when no thread is in the middle of its work."""
    with Interrupt() as interrupt:
        stats = loop.step()
    if interrupt.requested:
        raise KeyboardInterrupt
    return stats


def accumulate(
    path: Path,
    scene: Scene,
    settings: RenderSettings,
    chunk: int,
    deadline: float = math.inf,
    render: Callable[[Scene, RenderSettings, tqdm], Film] = render,
) -> LongRender:
    """Go on with the render kept at `path` until it has `settings.spp` samples a pixel or time is up.

    chunk: SPP of one render; the first has the seed `settings.seed`, the next ones those
    after it. deadline: no chunk begins after it, in seconds of `time.monotonic`. render:
    makes one chunk.
    Raises BokehguideError where the file cannot be written or was made from something else.
    """
    check_writable(path)
    origin = fingerprint(scene, settings)
    kept = read_long_render(path, origin) if path.exists() else empty_long_render(scene)
    with progress(path.stem, settings.spp, kept.spp) as bar:
        while kept.spp < settings.spp and time.monotonic() < deadline:
            spp = min(chunk, settings.spp - kept.spp)
            film = render(scene, replace(settings, spp=spp, seed=settings.seed + kept.chunks), bar)
            warn_of_bad_samples(film, path.stem)
            kept = kept.plus(film, spp)
            facts = {"scene": scene.name, "mode": settings.mode, "seed": settings.seed, "origin": origin}
            layers = {"beauty": kept.radiance.numpy(), "variance": kept.variance.numpy()}
            write_exr(path, layers, facts | {"spp": kept.spp, "chunks": kept.chunks})
    return kept


def progress(title: str, spp: int, done: int = 0) -> tqdm:
    """A bar over SPP; a log file gets a line now and then, a terminal a bar that moves."""
    interval = 0.1 if sys.stderr.isatty() else 30.0
    return tqdm(total=spp, initial=min(done, spp), desc=title, unit="SPP", mininterval=interval, dynamic_ncols=True)


def warn_of_bad_samples(film: Film, title: str) -> None:
    """Say on stderr where samples were left out: a mean without them may be wrong."""
    if film.bad_count:
        print(f"{title}: {film.bad_count} NaN or infinite samples, the first: {film.bad_samples[0]}", file=sys.stderr)


def empty_long_render(scene: Scene) -> LongRender:
    shape = (scene.film.height, scene.film.width)
    return LongRender(torch.zeros(*shape, 3, dtype=torch.float64), torch.zeros(shape, dtype=torch.float64))


def read_long_render(path: Path, origin: str) -> LongRender:
    """Raises BokehguideError for a file that is damaged or not of this `origin`."""
    facts = read_metadata(path)
    if facts.get("origin") != origin:
        raise BokehguideError(f"{path}: was made from another scene, mode or seed; remove it or choose another folder")
    planes = {name: torch.from_numpy(plane.astype(np.float64)) for name, plane in read_exr(path).items()}
    radiance = torch.stack([planes[name] for name in "RGB"], dim=-1)
    return LongRender(radiance, planes["variance.Y"], int(facts["spp"]), int(facts["chunks"]))
