"""The same scenes in bokehguide and in Mitsuba 3, compared by statistical tests.

    pip install '.[peers]'
    python scripts/compare_mitsuba.py materials glitter
    python scripts/compare_mitsuba.py scene.toml --modes lis-o --size 160x90 --json out/scene.json

SCENE is a built-in scene, a scene file, a model, a scene of `material_scenes.py`, or "materials" for all of these. Both
renderers get the scene with materials that both have (`mitsuba_scene.comparable`). Mitsuba renders it with its `path`
integrator through its thin lens.

Each mode renders R independent runs at four times the width and height; the mean of 4 × 4 pixels has the box filter of one
pixel. Each mean must lie within 0.5 % of Mitsuba's, with a standard error of at most 0.15 % from the variance among the runs
and Mitsuba's variance. The verdict "too few samples" stands for means within the errors whose standard error is larger; the exit
code is 1 as for a failure. Pixels, blocks, insets and frame must pass the tests of `mean_tests.py`. Mitsuba's render, kept in
`--cache`, needs many more samples than the runs: a pixel whose samples all miss the emitters has variance 0. Mitsuba sums in
single precision, so pixels are granted a relative error of ROUNDING. Rare light can fail a few pixels. These are rendered
again with 16 times the samples in both renderers (`retest_pixels.py`) and count as failed if they fail again. Without an
LLVM library (Debian: libllvm19) Mitsuba uses its slower variant `scalar_rgb`.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

if importlib.util.find_spec("mitsuba") is None:
    sys.exit("compare_mitsuba: error: Mitsuba is not installed; pip install '.[peers]'")

from experiments.material_scenes import MATERIAL_SCENES
from experiments.mean_tests import FINE, Outcome, Runs, at_least_two, brightness, finer, independent_runs, judge, report
from experiments.mitsuba_scene import CHUNK_SAMPLES, MitsubaFilm, MitsubaRenderer, comparable, left_out
from experiments.options import experiment_parser
from experiments.retest_pixels import PixelRetest
from torch.nn.functional import avg_pool2d
from tqdm import tqdm

from bokehguide.cli.parser import positive
from bokehguide.cli.scripts import run
from bokehguide.evaluation import LongRender, accumulate
from bokehguide.image import check_writable, write_text
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import RenderSettings

ROUNDING = 1e-4
"""Relative error granted to pixels, as Mitsuba sums in single precision."""
MEANS_WITHIN, STANDARD_ERROR = 5e-3, 1.5e-3


@dataclass(frozen=True)
class Comparison:
    """One mode on one scene.

    ratio: mean luminance over Mitsuba's; outcomes: of the tests; left_out: terms of the scene that neither renderer had.
    """

    scene: str
    mode: str
    ratio: float
    standard_error: float
    spp: int
    mitsuba_spp: int
    outcomes: list[Outcome]
    left_out: tuple[str, ...] = ()

    @property
    def means_agree(self) -> bool:
        return abs(self.ratio - 1.0) <= MEANS_WITHIN and self.standard_error <= STANDARD_ERROR

    @property
    def verdict(self) -> str:
        """Of the means. A standard error above the limit leaves open whether they agree."""
        if self.means_agree:
            return "passes"
        open_ = self.standard_error > STANDARD_ERROR and abs(self.ratio - 1.0) <= MEANS_WITHIN + 3.0 * self.standard_error
        return "too few samples" if open_ else "FAILS"


def main() -> int:
    args = parse()
    if args.json:
        check_writable(args.json)
    deadline = time.monotonic() + args.time_limit
    comparisons, unfinished = [], 0
    for whole in scenes(args.scenes, *args.size):
        scene = comparable(whole)
        lost = left_out(whole, scene)
        for line in lost:
            print(f"{scene.name}: left out, as Mitsuba has no counterpart: {line}", file=sys.stderr)
        reference = mitsuba_reference(scene, args.mitsuba_spp, args.cache, deadline)
        for mode in args.modes:
            if reference.spp < args.mitsuba_spp or time.monotonic() > deadline:
                print(f"{scene.name} {mode}: time limit reached; Mitsuba has {reference.spp} of {args.mitsuba_spp} SPP")
                unfinished += 1
                continue
            runs = our_runs(scene, mode, args.runs, args.spp, args.threads)
            retest = PixelRetest(scene, mode, args.runs, args.spp, args.mitsuba_spp, args.threads)
            found = compare(scene, mode, runs, reference, args.spp * args.runs, args.cache, retest)
            comparisons.append(replace(found, left_out=tuple(lost)))
    if args.json:
        write_text(args.json, json.dumps([asdict(one) for one in comparisons], indent=2) + "\n")
    return 1 if print_tables(comparisons) or unfinished else 0


def parse() -> argparse.Namespace:
    parser = experiment_parser(__doc__, "96x54", "uniform,lis-o", scene=str)
    add = parser.add_argument
    add("--spp", type=positive, default=4096, metavar="S", help="SPP of one run, a multiple of 16 (default: 4096)")
    add("--runs", type=at_least_two, default=16, metavar="R", help="runs of each mode (default: 16)")
    add("--mitsuba-spp", type=positive, default=131072, metavar="N", help="SPP of Mitsuba (default: 131072)")
    add(
        "--cache",
        type=Path,
        default=Path("out/mitsuba"),
        metavar="DIR",
        help="folder of Mitsuba's renders (default: out/mitsuba)",
    )
    add("--json", type=Path, metavar="PATH", help="write all numbers as a JSON list")
    args = parser.parse_args()
    if args.spp % FINE**2:
        parser.error(f"--spp: {args.spp} is not a multiple of {FINE**2}")
    return args


def scenes(names: list[str], width: int, height: int) -> list[Scene]:
    """The scenes of these names at this size."""
    names = [name for given in names for name in (MATERIAL_SCENES if given == "materials" else [given])]
    found = []
    for name in names:
        scene = MATERIAL_SCENES[name]() if name in MATERIAL_SCENES else load_scene(name, Overrides())
        found.append(replace(scene, film=replace(scene.film, width=width, height=height)))
    return found


def mitsuba_reference(scene: Scene, spp: int, folder: Path, deadline: float = math.inf) -> LongRender:
    """Mitsuba's render, begun or continued."""
    film = scene.film
    path = folder / f"{scene.name}-{film.width}x{film.height}-{film.max_depth}-mitsuba.exr"
    chunk = max(2, CHUNK_SAMPLES // (film.width * film.height))
    return accumulate(path, scene, RenderSettings("uniform", spp), chunk, deadline, by_mitsuba(scene))


def by_mitsuba(scene: Scene) -> Callable[[Scene, RenderSettings, tqdm], MitsubaFilm]:
    """A function that renders chunks of this scene."""
    renderer = MitsubaRenderer(scene)

    def render(_: Scene, settings: RenderSettings, bar: tqdm) -> MitsubaFilm:
        film = renderer.render(settings.spp, settings.seed)
        bar.update(settings.spp)
        return film

    return render


def our_runs(scene: Scene, mode: str, count: int, spp: int, threads: int | None = None) -> Runs:
    """Independent renders of `spp` samples per pixel, made with FINE × FINE finer pixels."""
    runs = independent_runs(finer(scene), RenderSettings(mode, spp // FINE**2, threads=threads), count)
    return Runs(avg_pool2d(runs.mean, FINE), avg_pool2d(runs.variance, FINE) / FINE**2)


def compare(
    scene: Scene, mode: str, runs: Runs, reference: LongRender, spp: int, folder: Path, retest: PixelRetest | None = None
) -> Comparison:
    """Ratio and tests; writes an image of the pixels' z into `folder`."""
    expected = brightness(reference.radiance)
    means = runs.mean.mean((1, 2)) / expected.mean()
    others = reference.variance.sum().sqrt() / expected.sum()
    error = (means.var() / len(means) + (means.mean() * others).square()).sqrt()
    outcomes = judge(scene, mode, runs, reference, folder, ROUNDING, retest)
    return Comparison(scene.name, mode, float(means.mean()), float(error), spp, reference.spp, outcomes)


def print_tables(comparisons: list[Comparison]) -> int:
    """Print the tables; returns the number of failures."""
    failed = report([outcome for one in comparisons for outcome in one.outcomes])
    print("\n| scene | mode | ours / Mitsuba | SPP, Mitsuba's | pixels within | at first | means |")
    print("| --- " * 2 + "| ---: " * 4 + "| --- |")
    for one in comparisons:
        pixels = next(outcome for outcome in one.outcomes if outcome.within is not None)
        ratio = f"{one.ratio:.5f} ± {one.standard_error:.5f}"
        shares = f"{pixels.within:.3%} | {pixels.at_first:.3%}"
        print(f"| {one.scene} | {one.mode} | {ratio} | {one.spp}, {one.mitsuba_spp} | {shares} | {one.verdict} |")
    for scene, lost in dict.fromkeys((one.scene, one.left_out) for one in comparisons if one.left_out):
        print(f"\nLeft out of {scene}, as Mitsuba has no counterpart: {'; '.join(lost)}.")
    return failed + sum(not one.means_agree for one in comparisons)


if __name__ == "__main__":
    run(main, "the same command continues Mitsuba's render")
