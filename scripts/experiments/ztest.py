"""Do guided renders have the means of uniform renders while the guide still learns?

    python scripts/experiments/ztest.py --cache out/ztest
    python scripts/experiments/ztest.py fairy-lights --cache out/ztest --mutate drop-cosine

Each mode renders R independent runs of S SPP; each run starts untrained. The tests of `mean_tests.py` compare their
luminances with those of one long uniform render, kept in `--cache`. Images of the pixels' z are written there as
`SCENE-MODE-z.png`. `--mutate` breaks the guided renders and not the uniform render; the tests must fail then.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from torch.nn.functional import avg_pool2d

sys.path.insert(0, str(Path(__file__).parents[1]))

from experiments.mean_tests import FINE, at_least_two, finer, independent_runs, judge, report
from experiments.mutations import MUTATIONS, Mutation
from experiments.options import experiment_parser, load_scenes

from bokehguide.cli.parser import positive
from bokehguide.cli.scripts import run
from bokehguide.evaluation import LongRender, accumulate
from bokehguide.scene import Scene
from bokehguide.train import RenderSettings

CHUNK = 128
UNIFORM_SEED = 3_000_000
"""Seed of the uniform render; run i of a guided one has seed i."""


def main() -> int:
    args = parse()
    scenes = load_scenes(args)
    deadline = time.monotonic() + args.time_limit
    outcomes, unfinished = [], 0
    for scene in scenes:
        uniform = uniform_render(scene, args, deadline)
        if uniform.spp < args.uniform_spp:
            print(f"{scene.name}: time limit reached at {uniform.spp} of {args.uniform_spp} SPP of uniform sampling")
            unfinished += 1
            continue
        for mode in args.modes:
            if time.monotonic() > deadline:
                print(f"{scene.name} {mode}: time limit reached")
                unfinished += 1
                continue
            settings = RenderSettings(mode, args.spp, threads=args.threads)
            with Mutation(args.mutate):
                runs = independent_runs(scene, settings, args.runs)
            outcomes += judge(scene, mode, runs, uniform, args.cache)
    return 1 if report(outcomes) or unfinished else 0


def parse() -> argparse.Namespace:
    parser = experiment_parser(__doc__, "160x90", "lis,lis-b,lis-o")
    add = parser.add_argument
    add("--spp", type=positive, default=256, metavar="S", help="SPP of one guided run (default: 256)")
    add("--runs", type=at_least_two, default=16, metavar="R", help="runs of each mode (default: 16)")
    add("--uniform-spp", type=positive, default=16384, metavar="N", help="SPP of the uniform render (default: 16384)")
    add("--cache", type=Path, required=True, metavar="DIR", help="folder of the uniform renders")
    add("--mutate", choices=MUTATIONS, help="break the estimator: the tests must fail")
    args = parser.parse_args()
    if args.uniform_spp % FINE**2:
        parser.error(f"--uniform-spp: {args.uniform_spp} is not a multiple of {FINE**2}")
    return args


def uniform_render(scene: Scene, args: argparse.Namespace, deadline: float) -> LongRender:
    """The uniform render, begun or continued at FINE times the size, averaged over FINE × FINE pixels."""
    large = finer(scene)
    path = args.cache / f"{scene.name}-{large.film.width}x{large.film.height}-uniform.exr"
    settings = RenderSettings("uniform", args.uniform_spp // FINE**2, UNIFORM_SEED, threads=args.threads)
    fine = accumulate(path, large, settings, CHUNK, deadline)
    radiance = avg_pool2d(fine.radiance.permute(2, 0, 1), FINE).permute(1, 2, 0)
    return LongRender(radiance, avg_pool2d(fine.variance[None], FINE)[0] / FINE**2, fine.spp * FINE**2, fine.chunks)


if __name__ == "__main__":
    run(main, "the same command continues the uniform render")
