"""Do guided renders have the mean of uniform ones, while the guide still learns?

    python scripts/ztest.py --cache out/ztest
    python scripts/ztest.py fairy-lights --cache out/ztest --mutate drop-cosine

Each mode renders R independent runs of S SPP, each learning from nothing. All tests compare
mean luminances with those of one long uniform render, kept in `--cache`.

Pixels: z = (m - u) / sqrt(v + w). m is the mean of the runs; v the mean of their films'
variances over R; u and w the uniform film's mean and variance. A film's estimate takes the
steps of a pixel for uncorrelated. Learning leaves them so: what a step draws from depends on
earlier steps only, and all have one mean. Their stratified film positions and first bounces
make the estimate a little too large. A pixel passes if its two-sided
normal p exceeds 1 - 0.99^(1 / pixels) (Šidák); 99.75 % of the pixels must pass, the rest
allowing for variances that a film underestimates.

Blocks of 16 × 16 pixels, insets, frame: Welch's t = (m - u) / sqrt(s² / R + w), with s² the
variance of the region's mean among the runs, which trusts no film of a guided render. w
adds up the uniform film's variances: its pixels are independent, and there are
millions to a region, so it has no degrees of freedom to speak of. A group of regions passes
if its smallest p, corrected for the number of regions, exceeds the level at which one test
in a hundred *calls of this script* would fail by chance.

The pixels' z-values are left behind as `SCENE-MODE-z.png` in `--cache`: black -6, grey 0,
white +6. `--mutate` breaks the guided renders, never the uniform one; the tests must fail.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from experiment import experiment_parser, load_scenes
from mutations import MUTATIONS, Mutation
from scipy import stats
from torch import Tensor
from torch.nn.functional import avg_pool2d

from bokehguide.cli.arguments import COMPILE_HELP, positive
from bokehguide.cli.scripts import run
from bokehguide.evaluation import LongRender, accumulate, progress, render, warn_of_bad_samples
from bokehguide.image import write_png
from bokehguide.render.vector import luminance
from bokehguide.scene import Scene
from bokehguide.train import RenderSettings

CHUNK = 128
FINE = 4
"""The uniform render's pixels to one that is tested, across and down: its box filter over 4 × 4 is the
box filter of one, and a large frame renders faster."""
UNIFORM_SEED = 3_000_000
"""Of the uniform render; run i of a guided one has seed i."""
BLOCK = 16
LEVEL = 0.01
PIXELS_WITHIN = 0.9975
FEW = 0.01
"""Pixels that fail are worth a second look where there are no more of them."""
ROUNDING = 1e-6
"""Relative error granted to float32 where all samples of a pixel are equal."""


@dataclass(frozen=True)
class Runs:
    """Independent renders: luminance and its film's variance, both float64 `[R, H, W]`."""

    mean: Tensor
    variance: Tensor


@dataclass(frozen=True)
class Outcome:
    """One test. statistic: the z or t of the largest size; p: of a group of regions, None for pixels.

    within: share of the pixels that pass; at_first: before any was looked at again.
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
        return self.within >= PIXELS_WITHIN if self.p is None else self.p > level


def main() -> int:
    args = parse()
    scenes = load_scenes(args)
    deadline = time.monotonic() + args.time_limit
    outcomes, unfinished = [], 0
    for scene in scenes:
        uniform = uniform_render(scene, args, deadline)
        if uniform.spp < args.uniform_spp:
            print(f"{scene.name}: time is up at {uniform.spp} of {args.uniform_spp} SPP of uniform sampling")
            unfinished += 1
            continue
        for mode in args.modes:
            if time.monotonic() > deadline:
                print(f"{scene.name} {mode}: time is up")
                unfinished += 1
                continue
            settings = RenderSettings(mode, args.spp, threads=args.threads, compile=args.compile)
            runs = independent_runs(scene, settings, args.runs, args.mutate)
            outcomes += judge(scene, mode, runs, uniform, args.cache)
    return 1 if report(outcomes) or unfinished else 0


def parse() -> argparse.Namespace:
    parser = experiment_parser(__doc__, "160x90", "lis,lis-b,lis-o")
    add = parser.add_argument
    add("--spp", type=positive, default=256, metavar="S", help="of one guided run, default 256")
    add("--runs", type=at_least_two, default=16, metavar="R", help="of each mode, default 16")
    add("--uniform-spp", type=positive, default=16384, metavar="N", help="default 16384")
    add("--cache", type=Path, required=True, metavar="DIR", help="where the uniform renders are kept")
    add("--compile", action="store_true", help=COMPILE_HELP)
    add("--mutate", choices=MUTATIONS, help="break the estimator, to see the tests fail")
    args = parser.parse_args()
    if args.uniform_spp % FINE**2:
        parser.error(f"--uniform-spp: {args.uniform_spp} is not a multiple of {FINE**2}")
    return args


def uniform_render(scene: Scene, args: argparse.Namespace, deadline: float) -> LongRender:
    """The uniform render, begun or continued with finer pixels, as the pixels that are tested."""
    film = replace(scene.film, width=FINE * scene.film.width, height=FINE * scene.film.height)
    path = args.cache / f"{scene.name}-{film.width}x{film.height}-uniform.exr"
    settings = RenderSettings("uniform", args.uniform_spp // FINE**2, UNIFORM_SEED, threads=args.threads)
    fine = accumulate(path, replace(scene, film=film), settings, CHUNK, deadline)
    radiance = avg_pool2d(fine.radiance.permute(2, 0, 1), FINE).permute(1, 2, 0)
    return LongRender(radiance, avg_pool2d(fine.variance[None], FINE)[0] / FINE**2, fine.spp * FINE**2, fine.chunks)


def at_least_two(text: str) -> int:
    if positive(text) < 2:
        raise argparse.ArgumentTypeError("one run has no spread; give at least 2")
    return int(text)


def independent_runs(scene: Scene, settings: RenderSettings, count: int, mutation: str | None = None) -> Runs:
    """So many renders at seeds 0, 1, …, mutated if so asked."""
    films, title = [], f"{scene.name} {settings.mode}"
    with progress(title, count * settings.spp) as bar, Mutation(mutation):
        for seed in range(count):
            films.append(render(scene, replace(settings, seed=seed), bar))
            if mutation is None:
                warn_of_bad_samples(films[-1], f"{title}, seed {seed}")
    means = [brightness(film.radiance().cpu()) for film in films]
    return Runs(torch.stack(means), torch.stack([film.variance().cpu().double() for film in films]))


def judge(
    scene: Scene,
    mode: str,
    runs: Runs,
    uniform: LongRender,
    folder: Path,
    rounding: float = ROUNDING,
    look_again: Callable[[Tensor], tuple[Tensor, ...]] | None = None,
) -> list[Outcome]:
    """All tests of one mode on one scene; leaves a picture of the pixels' z-values behind.

    rounding: relative error that is granted to every pixel. look_again: renders the pixels of a mask `[H, W]` once more,
    independently, where at most FEW of them fail: mean and variance, the other side's mean and variance, `[K]`.
    """
    expected = brightness(uniform.radiance)
    z = z_values(runs.mean.mean(0), runs.variance.mean(0) / len(runs.mean), expected, uniform.variance, rounding)
    at_first = within = share_within(z)
    failing = fails(z)
    if look_again is not None and 0.0 < 1.0 - at_first <= FEW:
        z[failing] = z_values(*look_again(failing), rounding)
        within = share_within(z)
    outcomes = [Outcome(scene.name, mode, "pixels", z.numel(), largest(z), within=within, at_first=at_first)]
    for group, sums in REGIONS.items():
        if group == "insets" and not scene.insets:
            continue
        count = sums(torch.ones_like(expected)[None], scene)[0]
        difference = (sums(runs.mean, scene) - sums(expected[None], scene)) / count
        w = sums((uniform.variance + (rounding * expected).square())[None], scene)[0] / count.square()
        t, p = welch(difference, w)
        family = -math.expm1(len(t) * math.log1p(-float(p.min()))) if p.min() < 1.0 else 1.0
        outcomes.append(Outcome(scene.name, mode, group, len(t), largest(t), p=family))
    write_png(folder / f"{scene.name}-{mode}-z.png", (0.5 + z / 12.0)[..., None].expand(-1, -1, 3))
    return outcomes


def z_values(mean: Tensor, variance: Tensor, expected: Tensor, other: Tensor, rounding: float) -> Tensor:
    """Differences of means in units of their standard errors; variances are of the means, `rounding` is a relative error."""
    granted = (rounding * expected).square()
    return ((mean - expected) / (variance + other + granted).sqrt()).nan_to_num(0.0)


def fails(z: Tensor) -> Tensor:
    """Which pixels' z-values lie outside the bounds of so many tests."""
    return torch.from_numpy(2.0 * stats.norm.sf(z.abs().numpy()) <= corrected(LEVEL, z.numel()))


def share_within(z: Tensor) -> float:
    return 1.0 - float(fails(z).double().mean())


def welch(difference: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """t and two-sided p `[G]` for runs `[R, G]` of a difference whose other side has variance `other` `[G]`."""
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
    """Sums `[R, 1]` over everything."""
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
    """The level of each of so many tests at which any of them fails by chance with `level` (Šidák)."""
    return -math.expm1(math.log1p(-level) / tests)


def largest(statistics: Tensor) -> float:
    """The value of the largest size, with its sign."""
    return float(statistics.flatten()[statistics.abs().argmax()])


def report(outcomes: list[Outcome]) -> int:
    """Print the table; returns the number of tests that failed."""
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


if __name__ == "__main__":
    run(main, "the same command goes on with the uniform render")
