"""Long renders that can be stopped and continued.

A long render is the mean of many short, independent renders ("chunks"), each with its own seed. It is kept in an EXR after
every chunk and after an interruption, so that the same command continues it. The file has a fingerprint of the scene, mode and
seed, but not of the version of the path tracer: remove the file if the path tracer has changed.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from bokehguide.errors import BokehguideError
from bokehguide.evaluation.fingerprint import fingerprint
from bokehguide.image import check_writable, read_exr, read_metadata, write_exr
from bokehguide.render.film import Film
from bokehguide.runtime.bars import progress
from bokehguide.runtime.interrupt import Interrupt
from bokehguide.scene.types import Scene
from bokehguide.train import RenderLoop, RenderSettings, StepStats

FEWEST_SPP = 2
"""SPP of an interrupted chunk that is kept: fewer samples have no estimate of the variance."""


@dataclass(frozen=True)
class LongRender:
    """A mean of independent renders.

    radiance: `[H, W, 3]`; variance: of the luminance of `radiance`, `[H, W]`, both float64;
    spp: samples per pixel so far; chunks: renders so far.
    """

    radiance: Tensor
    variance: Tensor
    spp: int = 0
    chunks: int = 0

    def plus(self, film: RenderedFilm, spp: int) -> LongRender:
        """The mean of this render and of another one of `spp` samples per pixel, weighted by their samples."""
        total = self.spp + spp
        radiance = (self.spp * self.radiance + spp * film.radiance().cpu()) / total
        variance = (self.spp**2 * self.variance + spp**2 * film.variance().cpu()) / total**2
        return LongRender(radiance, variance, total, self.chunks + 1)


class RenderedFilm(Protocol):
    """The parts of a film that a long render needs, of bokehguide or of another renderer."""

    @property
    def bad_count(self) -> int: ...
    @property
    def bad_samples(self) -> Sequence[object]: ...
    def radiance(self) -> Tensor: ...
    def variance(self) -> Tensor: ...


class InterruptedRender(KeyboardInterrupt):
    """Raised by Ctrl-C within a render that has taken some steps. film: of these steps; spp: number of the steps."""

    def __init__(self, film: RenderedFilm, spp: int):
        super().__init__()
        self.film, self.spp = film, spp


def render(scene: Scene, settings: RenderSettings, bar: tqdm) -> Film:
    """The film of one render. bar: gets one update per step. Raises InterruptedRender after a step at Ctrl-C."""
    with RenderLoop(scene, settings) as loop:
        try:
            for _ in range(settings.spp):
                whole_step(loop)
                bar.update()
        except KeyboardInterrupt as error:
            raise InterruptedRender(loop.film, loop.step_number) from error
        return loop.film


def whole_step(loop: RenderLoop) -> StepStats:
    """One step of a render. Ctrl-C takes effect after the step, when no thread is at work."""
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
    render: Callable[[Scene, RenderSettings, tqdm], RenderedFilm] = render,
) -> LongRender:
    """Continue the render kept at `path` until it has `settings.spp` samples per pixel or the deadline passes.

    chunk: SPP of one render, whose seed is `settings.seed` plus its number; deadline: in seconds of `time.monotonic`, after
    which no chunk begins; render: renders one chunk.
    Raises BokehguideError if the file cannot be written or belongs to another render.
    """
    check_writable(path)
    inputs = fingerprint(scene, settings)
    kept = read_long_render(path, inputs) if path.exists() else empty_long_render(scene)
    with progress(path.stem, settings.spp, kept.spp) as bar:
        while kept.spp < settings.spp and time.monotonic() < deadline:
            spp, interruption = min(chunk, settings.spp - kept.spp), None
            try:
                film = render(scene, replace(settings, spp=spp, seed=settings.seed + kept.chunks), bar)
            except InterruptedRender as error:
                if error.spp < FEWEST_SPP:
                    raise
                film, spp, interruption = error.film, error.spp, error
            warn_of_bad_samples(film, path.stem)
            kept = kept.plus(film, spp)
            facts = {"scene": scene.name, "mode": settings.mode, "seed": settings.seed, "fingerprint": inputs}
            layers = {"beauty": kept.radiance.numpy(), "variance": kept.variance.numpy()}
            write_exr(path, layers, facts | {"spp": kept.spp, "chunks": kept.chunks})
            if interruption is not None:
                raise interruption
    return kept


def warn_of_bad_samples(film: RenderedFilm, title: str) -> None:
    """Warn on stderr if samples were left out: the mean of the others may be biased."""
    if film.bad_count:
        print(f"{title}: {film.bad_count} NaN or infinite samples, the first: {film.bad_samples[0]}", file=sys.stderr)


def empty_long_render(scene: Scene) -> LongRender:
    """A long render of no chunks."""
    shape = (scene.film.height, scene.film.width)
    return LongRender(torch.zeros(*shape, 3, dtype=torch.float64), torch.zeros(shape, dtype=torch.float64))


def read_long_render(path: Path, inputs: str) -> LongRender:
    """The render kept in a file. Raises BokehguideError for a damaged file or another fingerprint than `inputs`."""
    facts = read_metadata(path)
    if facts.get("fingerprint") != inputs:
        raise BokehguideError(f"{path}: is a render of another scene, mode or seed; remove it or choose another folder")
    planes = {name: torch.from_numpy(plane.astype(np.float64)) for name, plane in read_exr(path).items()}
    radiance = torch.stack([planes[name] for name in "RGB"], dim=-1)
    return LongRender(radiance, planes["variance.Y"], int(facts["spp"]), int(facts["chunks"]))
