"""Statistical tests of whether independent renders have the means of a reference, for `ztest.py` and `compare_mitsuba.py`.

Pixels: z = (m - u) / sqrt(v + w). m is the mean of the R runs, v the mean of their films' variances over R; u and w are
the mean and the variance of the reference. A film's variance treats the steps of a pixel as uncorrelated. Learning keeps
them uncorrelated: a step samples from the state at its start, and all steps have one mean. Stratified film positions
and first bounces make the estimated variance slightly too large. A pixel passes if its two-sided normal p exceeds
1 - 0.99^(1 / pixels) (Šidák). PIXELS_WITHIN of the pixels must pass; the rest allows for underestimated variances.

Blocks of 16 × 16 pixels, insets, frame: Welch's t = (m - u) / sqrt(s² / R + w). s² is the variance of the region's mean
among the runs and does not depend on a film's estimate. w adds up the variances of the reference's pixels, which are
independent; with millions of samples a region, w counts as exact. A group of regions passes if its smallest p, corrected
for the number of regions, exceeds the level at which one call of the script in a hundred fails by chance.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from scipy import stats
from torch import Tensor
from torch.nn.functional import avg_pool2d

from bokehguide.cli.parser import positive
from bokehguide.evaluation import LongRender, progress, render, warn_of_bad_samples
from bokehguide.image import write_png
from bokehguide.render.vector import luminance
from bokehguide.scene import Scene
from bokehguide.train import RenderSettings

FINE = 4
"""A reference has FINE × FINE pixels for each tested one: their mean has the same box filter, and large frames render faster."""
BLOCK = 16
LEVEL = 0.01
PIXELS_WITHIN = 0.9975
FEW = 0.01
"""Failing pixels are rendered again if their share is at most this."""
ROUNDING = 1e-6
"""Relative error granted to float32 where all samples of a pixel are equal."""


@dataclass(frozen=True)
class Runs:
    """Independent renders: luminance and its film's variance, both float64 `[R, H, W]`."""

    mean: Tensor
    variance: Tensor


@dataclass(frozen=True)
class Outcome:
    """One test. statistic: the z or t of the largest magnitude; p: of a group of regions, None for pixels.

    within: share of the pixels that pass; at_first: the same share before pixels were rendered again.
    """

    scene: str
    mode: str
    group: str
    count: int
    statistic: float
    within: float | None = None
    p: float | None = None
    at_first: float | None = None

    def passes(self, level: float) -> bool:
        if self.p is not None:
            return self.p > level
        return self.within is not None and self.within >= PIXELS_WITHIN


def at_least_two(text: str) -> int:
    if positive(text) < 2:
        raise argparse.ArgumentTypeError("one run has no variance; give at least 2")
    return int(text)


def finer(scene: Scene) -> Scene:
    """The scene with FINE × FINE pixels for each of its pixels."""
    return replace(scene, film=replace(scene.film, width=FINE * scene.film.width, height=FINE * scene.film.height))


def independent_runs(scene: Scene, settings: RenderSettings, count: int) -> Runs:
    """Renders at the seeds 0 to `count` - 1."""
    films, title = [], f"{scene.name} {settings.mode}"
    with progress(title, count * settings.spp) as bar:
        for seed in range(count):
            films.append(render(scene, replace(settings, seed=seed), bar))
            warn_of_bad_samples(films[-1], f"{title}, seed {seed}")
    means = [brightness(film.radiance().cpu()) for film in films]
    return Runs(torch.stack(means), torch.stack([film.variance().cpu().double() for film in films]))


def judge(
    scene: Scene,
    mode: str,
    runs: Runs,
    reference: LongRender,
    folder: Path,
    rounding: float = ROUNDING,
    retest: Callable[[Tensor], tuple[Tensor, ...]] | None = None,
) -> list[Outcome]:
    """All tests of one mode on one scene; writes an image of the pixels' z into `folder`.

    The image is `SCENE-MODE-z.png`: black is -6, grey 0, white +6.

    rounding: relative error granted to every pixel. retest: renders the pixels of a mask `[H, W]` again, independently, if
    at most FEW of them fail; returns mean, its variance, the reference's mean and its variance, `[K]` each.
    """
    expected = brightness(reference.radiance)
    z = z_values(runs.mean.mean(0), runs.variance.mean(0) / len(runs.mean), expected, reference.variance, rounding)
    at_first = within = share_within(z)
    failing = fails(z)
    if retest is not None and 0.0 < 1.0 - at_first <= FEW:
        z[failing] = z_values(*retest(failing), rounding)
        within = share_within(z)
    outcomes = [Outcome(scene.name, mode, "pixels", z.numel(), largest(z), within=within, at_first=at_first)]
    for group, sums in REGIONS.items():
        if group == "insets" and not scene.insets:
            continue
        count = sums(torch.ones_like(expected)[None], scene)[0]
        difference = (sums(runs.mean, scene) - sums(expected[None], scene)) / count
        variance = sums((reference.variance + (rounding * expected).square())[None], scene)[0] / count.square()
        t, p = welch(difference, variance)
        family = -math.expm1(len(t) * math.log1p(-float(p.min()))) if p.min() < 1.0 else 1.0
        outcomes.append(Outcome(scene.name, mode, group, len(t), largest(t), p=family))
    write_png(folder / f"{scene.name}-{mode}-z.png", (0.5 + z / 12.0)[..., None].expand(-1, -1, 3))
    return outcomes


def z_values(mean: Tensor, variance: Tensor, expected: Tensor, expected_variance: Tensor, rounding: float) -> Tensor:
    """Differences of means over their standard errors; variances are those of the means."""
    granted = (rounding * expected).square()
    return ((mean - expected) / (variance + expected_variance + granted).sqrt()).nan_to_num(0.0)


def fails(z: Tensor) -> Tensor:
    """Mask of the pixels whose z lies outside the bounds of `z.numel()` tests."""
    return torch.from_numpy(2.0 * stats.norm.sf(z.abs().numpy()) <= corrected(LEVEL, z.numel()))


def share_within(z: Tensor) -> float:
    return 1.0 - float(fails(z).double().mean())


def welch(difference: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """t and two-sided p `[G]` of differences `[R, G]` in R runs from means of variance `other` `[G]`."""
    runs = len(difference)
    own = difference.var(0) / runs
    t = (difference.mean(0) / (own + other).sqrt()).nan_to_num(0.0)
    freedom = ((runs - 1) * ((own + other) / own.clamp(min=1e-300)).square()).clamp(runs - 1, 1e9)
    return t, torch.from_numpy(2.0 * stats.t.sf(t.abs().numpy(), freedom.numpy()))


def block_sums(images: Tensor, scene: Scene) -> Tensor:
    """Sums `[R, G]` of `[R, H, W]` over blocks; those at the right and bottom may be smaller."""
    return avg_pool2d(images[:, None], BLOCK, ceil_mode=True, divisor_override=1).flatten(1)


def inset_sums(images: Tensor, scene: Scene) -> Tensor:
    """Sums `[R, G]` over the scene's insets."""
    boxes = [inset.pixels(scene.film.width, scene.film.height) for inset in scene.insets]
    return torch.stack([images[:, rows, columns].sum((1, 2)) for rows, columns in boxes], dim=1)


def frame_sums(images: Tensor, scene: Scene) -> Tensor:
    """Sums `[R, 1]` over the frame."""
    return images.sum((1, 2))[:, None]


REGIONS: dict[str, Callable[[Tensor, Scene], Tensor]] = {
    "blocks": block_sums,
    "insets": inset_sums,
    "frame": frame_sums,
}


def brightness(radiance: Tensor) -> Tensor:
    """Luminance, float64 `[H, W]`, of `[H, W, 3]`."""
    return luminance(radiance.double().movedim(-1, 0))


def corrected(level: float, tests: int) -> float:
    """The level of each of `tests` tests at which any of them fails by chance with probability `level` (Šidák)."""
    return -math.expm1(math.log1p(-level) / tests)


def largest(statistics: Tensor) -> float:
    """The value of the largest magnitude, with its sign."""
    return float(statistics.flatten()[statistics.abs().argmax()])


def report(outcomes: list[Outcome]) -> int:
    """Print the table; returns the number of failed tests."""
    level = corrected(LEVEL, max(1, sum(outcome.p is not None for outcome in outcomes)))
    print("| scene | mode | test | regions | largest z or t | pixels within | p | |\n" + "| --- " * 3 + "| ---: " * 4 + "| --- |")
    for one in outcomes:
        within = "" if one.within is None else f"{one.within:.4%}"
        p = "" if one.p is None else f"{one.p:.3g}"
        verdict = "passes" if one.passes(level) else "FAILS"
        print(f"| {one.scene} | {one.mode} | {one.group} | {one.count} | {one.statistic:+.2f} | {within} | {p} | {verdict} |")
    failed = sum(not outcome.passes(level) for outcome in outcomes)
    print(f"\n{failed} of {len(outcomes)} tests fail (pixels within < {PIXELS_WITHIN:.2%}, or p < {level:.2g})")
    return failed
