"""Adaptive SPP: a render that stops in each block of pixels when the estimated error reaches a target.

A rule that stops a render by the render's own samples causes a bias, because it stops early where highlights are not found yet.
Therefore two independent renders (halves) have half of the samples per pixel (SPP) each. The error of one half decides where the
other half stops. The number of a pixel's samples in one half depends only on the other half, so that both halves are unbiased.
The picture is the mean of both halves with equal weights.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from bokehguide.errors import BokehguideError
from bokehguide.render.film import Film, FilmSamples
from bokehguide.render.halves_film import HalfFilm, HalvesFilm
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import hash_int
from bokehguide.render.split_film import relative_error
from bokehguide.render.vector import luminance
from bokehguide.runtime.distributed import Ranks
from bokehguide.runtime.indexing import Pixels, gather_pixels, scatter_add
from bokehguide.scene.types import Scene
from bokehguide.train.loop import PHASES, RenderLoop
from bokehguide.train.loop_base import Loop, require_inputs
from bokehguide.train.loop_state import REMEDY, all_or_nothing, require_one_moment, require_parts
from bokehguide.train.settings import RenderSettings
from bokehguide.train.step_stats import StepStats

BLOCK = 32
"""Side of a block in pixels. All pixels of a block stop together. A block contains whole groups of `guiding/pixel_reuse.py`."""
FIRST_ROUND = 8
"""Number of steps of each half in the first round. Each later round has as many steps as all earlier rounds together."""


def make_loop(scene: Scene, settings: RenderSettings, ranks: Ranks | None = None) -> RenderLoop | AdaptiveLoop:
    """An `AdaptiveLoop` if the settings have a target noise, else a `RenderLoop`. Raises BokehguideError as `RenderLoop`."""
    require_inputs(scene, settings)
    return RenderLoop(scene, settings, ranks) if settings.target_noise is None else AdaptiveLoop(scene, settings, ranks)


def to_blocks(images: Tensor) -> Tensor:
    """Images `[C, H, W]` cut into blocks `[C, blocks, BLOCK, BLOCK]`. Blocks beyond the edge of the image repeat the edge."""
    height, width = images.shape[1:]
    rows, columns = math.ceil(height / BLOCK), math.ceil(width / BLOCK)
    padded = pad(images, (0, columns * BLOCK - width, 0, rows * BLOCK - height), mode="replicate")
    return padded.reshape(len(images), rows, BLOCK, columns, BLOCK).transpose(2, 3).flatten(1, 2)


def from_blocks(blocks: Tensor, height: int, width: int) -> Tensor:
    """The image `[H, W]` of blocks `[blocks, BLOCK, BLOCK]`."""
    columns = math.ceil(width / BLOCK)
    rows = blocks.reshape(-1, columns, BLOCK, BLOCK).transpose(1, 2)
    return rows.reshape(-1, columns * BLOCK)[:height, :width]


class HalfLoop(RenderLoop):
    """One of the two halves. A step renders all blocks that are open in either half. The film adds samples in its open blocks."""

    def __init__(self, scene: Scene, settings: RenderSettings, ranks: Ranks | None, tracer: PathTracer | None = None):
        super().__init__(scene, settings, ranks, tracer)
        pixels = self.film.width * self.film.height
        self.brightness = torch.zeros(2, pixels, dtype=torch.float64, device=settings.device)
        """Sums of the luminance of samples before this round and in this round, `[2, pixels]`."""
        self._counted: Tensor | None = None

    def _film_class(self) -> type[Film]:
        return HalfFilm

    def count_only(self, counted: Tensor) -> None:
        """From now on put only samples of `counted` pixels on the film, bool `[pixels]`."""
        self._counted = counted

    def _update_roulette(self) -> None:
        """Only before the first decision. From then on, the other half decides which samples are on the film."""
        if self.step_number <= 2 * FIRST_ROUND + 1:
            super()._update_roulette()

    def _light_so_far(self) -> tuple[float, float]:
        """Includes samples that are not on the film, because the other half decides which samples are on the film."""
        light = self.brightness[:, self.pixels.own].cpu().numpy()
        return float(light.sum()), float(self.step_number * light.shape[1])

    def _picture_so_far(self) -> Tensor:
        """The luminance of all samples, in each channel."""
        mean = (self.brightness.sum(0) / self.step_number).float().expand(3, -1)
        return mean * self.pixels.mine.to(mean.device)

    def _expose(self, places: Pixels, samples: FilmSamples) -> Tensor:
        light = luminance(samples.value())
        scatter_add(self.brightness[1], places, light.nan_to_num(0.0, 0.0, 0.0))
        counted = None if self._counted is None else gather_pixels(self._counted, places)
        return self.film.add(places, samples, self.step_number, self.mode.lens.is_independent(self.step_number), counted)

    def end_round(self) -> Tensor:
        """Estimated relative error `[pixels]` of the mean of both halves; collective.

        The mean before the round and the mean in the round are over equally many samples of this half. Half of their difference
        estimates the error of the half. The error of the mean of both halves is smaller by the factor √2.
        """
        mine = self.pixels.mine.to(self.brightness.device)
        means = self.ranks.total(self.brightness * mine) / (self.step_number // 2)
        self.brightness[0] += self.brightness[1]
        self.brightness[1] = 0.0
        # Each block separately: in other blocks, the samples of the round may be missing, by a decision of the other half.
        before, now = to_blocks(means.reshape(2, self.film.height, self.film.width))
        error = from_blocks(relative_error(before, now), self.film.height, self.film.width)
        return error.flatten() / math.sqrt(2.0)


class AdaptiveLoop(Loop):
    """A loop like `RenderLoop` that stops each block of 32 × 32 pixels at the estimated error `settings.target_noise`.

    Steps alternate between two halves. When both halves have 16, 32, 64, … steps, each half stops in the blocks in which the
    error of the other half has reached the target. A half may stop in a block before the other half. It then continues to render
    the block without adding samples to the film, because the other half needs its error estimate.
    """

    def __init__(self, scene: Scene, settings: RenderSettings, ranks: Ranks | None = None):
        self.scene, self.settings, self.ranks = scene, settings, ranks or Ranks()
        first = HalfLoop(scene, settings, self.ranks)
        other = replace(settings, seed=hash_int(settings.seed + 1) >> 1)
        second = HalfLoop(scene, other, self.ranks, first.tracer)
        second.workers = first.workers
        self.halves = (first, second)
        self.camera, self.mode, self.workers = first.camera, first.mode, first.workers
        film = first.film
        pixels = torch.arange(film.width * film.height, device=settings.device)
        across = math.ceil(film.width / BLOCK)
        self._block = pixels // film.width // BLOCK * across + pixels % film.width // BLOCK
        self._size = torch.bincount(self._block)
        self.open = torch.ones(2, len(self._size), dtype=torch.bool, device=settings.device)
        """Whether each half adds samples to the film in each block, bool `[2, blocks]`."""
        self.expected_steps: int | None = None
        """Steps after which the worst block should reach the target; None before the first decision."""

    @property
    def step_number(self) -> int:
        return sum(half.step_number for half in self.halves)

    @property
    def complete(self) -> bool:
        """Whether the render has all its SPP, or every block has reached the target noise."""
        return self.finished or self.step_number >= self.settings.spp

    @property
    def finished(self) -> bool:
        """Whether every block has reached the target."""
        return not bool(self.open.any())

    @property
    def finished_share(self) -> float:
        """Share of the blocks that have reached the target."""
        return 1.0 - float(self.open.any(0).double().mean())

    @property
    def phases(self) -> dict[str, float]:
        """As `RenderLoop.phases`."""
        total = sum((Counter(half.phases) for half in self.halves), Counter())
        return {phase: total[phase] for phase in PHASES}

    def step(self, last: bool = False) -> StepStats:
        """Render one more sample for each pixel of the open blocks, in one of the halves. last: see `RenderLoop.step`."""
        stats = self.halves[self.step_number % 2].step(last)
        steps = self.halves[1].step_number
        if self.step_number == 2 * steps and steps >= FIRST_ROUND and steps & (steps - 1) == 0:
            self._end_round(steps)
        return replace(stats, step=self.step_number)

    def _end_round(self, steps: int) -> None:
        errors = torch.stack([self._block_means(half.end_round()) for half in self.halves])
        if steps == FIRST_ROUND:  # no earlier round to compare with
            return
        self._close(errors)

    def _close(self, errors: Tensor) -> None:
        """Stop each half in the blocks in which the error of the other half has reached the target. errors: `[2, blocks]`."""
        assert self.settings.target_noise is not None
        self.open &= errors.flip(0) > self.settings.target_noise
        worst = float((errors.flip(0) * self.open).max()) / self.settings.target_noise
        # The error falls with the root of the steps, which double each round.
        self.expected_steps = self.step_number << math.ceil(2.0 * math.log2(min(max(worst, 1.0), 1e9)))
        if not bool(self.open.all()):
            self._render_open_blocks()

    def _block_means(self, error: Tensor) -> Tensor:
        sums = torch.zeros(len(self._size), dtype=torch.float64, device=error.device)
        return sums.index_add_(0, self._block, error) / self._size

    def _render_open_blocks(self) -> None:
        """Render only open blocks. A half stops learning when it first stops a block of the other half.

        Before this time, a half learns from all of its own pixels. Its learned state and its decisions therefore do not depend on
        the other half.
        """
        active = self.open.any(0)[self._block]
        for half, counted, decided in zip(self.halves, self.open, self.open.flip(0)):
            half.render_only(active)
            half.count_only(counted[self._block])
            if not bool(decided.all()):
                half.freeze()

    def picture(self) -> Film | HalvesFilm:
        """The mean of the halves with the pixels of all ranks; collective."""
        films = [half.picture() for half in self.halves]
        return HalvesFilm(*films) if self.halves[1].step_number else films[0]

    def guide_images(self) -> dict[str, Tensor]:
        """As `RenderLoop.guide_images`, of the first half."""
        return self.halves[0].guide_images()

    def state_dict(self) -> dict[str, object]:
        """As `RenderLoop.state_dict`; collective."""
        halves = [half.state_dict() for half in self.halves]
        mine = [half.pixels.mine for half in self.halves]
        return {
            "step": self.step_number,
            "halves": halves,
            "open": self.open,
            "brightness": [self.ranks.merged({"": half.brightness}, own)[""] for half, own in zip(self.halves, mine)],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """As `RenderLoop.load_state_dict`."""
        place = "AdaptiveLoop.load_state_dict"
        own: dict[str, Any] = self.state_dict()
        self._require_state(place, state, own)
        with all_or_nothing(place, *((half.load_learned, present) for half, present in zip(self.halves, own["halves"]))):
            for half, saved in zip(self.halves, state["halves"]):
                half.load_learned(saved)
        for half, saved, brightness in zip(self.halves, state["halves"], state["brightness"]):
            half.load_film(saved)
            half.brightness.copy_(brightness)
        self.open.copy_(state["open"])
        if not bool(self.open.all()):
            self._render_open_blocks()

    def _require_state(self, place: str, state: Mapping[str, Any], own: Mapping[str, Any]) -> None:
        """Raise BokehguideError unless `state` fits `own`, the state of this loop, and is of one moment."""
        require_parts(place, state, own, apart="halves")
        halves = state["halves"]
        if not (isinstance(halves, (list, tuple)) and len(halves) == 2):
            raise BokehguideError(f"{place}: halves is no list of two states; {REMEDY}")
        for half, saved, of_own in zip(self.halves, halves, own["halves"]):
            half.require_state(place, saved, of_own)
        shapes = [[each.shape for each in (one["open"], *one["brightness"])] for one in (state, own)]
        if shapes[0] != shapes[1] or state["step"] != sum(saved["step"] for saved in halves):
            raise BokehguideError(f"{place}: the blocks or the steps are those of another render; {REMEDY}")
        for saved, still in zip(halves, state["open"]):
            require_one_moment(place, saved, still.to(self._block.device)[self._block])
