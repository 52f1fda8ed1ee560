"""Time of a step, function by function.

    python scripts/profile_step.py --mode guided
    python scripts/profile_step.py --scene chrome --mode uniform --size 640x360

One thread renders. Time in PyTorch, NumPy, Embree and the native core counts for the calling function. All rows but the last
include the profiler's overhead.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from bokehguide.cli.parser import Parser, natural, positive, size
from bokehguide.cli.scripts import run
from bokehguide.evaluation import markdown
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import MODES, RenderLoop, RenderSettings

PACKAGE = "bokehguide"
SHOWN = 40
"""Rows of the table."""


class Profile(NamedTuple):
    """Nanoseconds per ray by function; rays per sample; nanoseconds of processor time per ray without the profiler."""

    functions: Counter[str]
    rays_per_sample: float
    whole: float


def main() -> None:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="fairy-lights")
    parser.add_argument("--mode", choices=MODES, default="guided")
    parser.add_argument("--size", type=size, default="1280x720", metavar="WxH", help="default: 1280x720")
    parser.add_argument("--spp", type=positive, default=4, metavar="N", help="profiled steps (default: 4)")
    parser.add_argument("--warm-up", type=natural, default=9, metavar="N", help="steps before the measurement (default: 9)")
    args = parser.parse_args()
    print(table(profiled(args), args))


def table(profile: Profile, args: argparse.Namespace) -> str:
    """The SHOWN functions that take most of the time, in Markdown."""
    rays = f"{profile.rays_per_sample:.2f} rays per sample"
    title = f"{args.scene} {args.mode} {'x'.join(map(str, args.size))}, one thread, {rays}"
    rows = [["function", "ns per ray"]]
    rows += [[name, f"{value:.1f}"] for name, value in profile.functions.most_common(SHOWN)]
    rows.append(["whole step, without the profiler", f"{profile.whole:.1f}"])
    return f"{title}\n\n{markdown(rows)}"


def profiled(args: argparse.Namespace) -> Profile:
    scene = load_scene(args.scene, Overrides(*args.size))
    loop = RenderLoop(scene, RenderSettings(args.mode, args.warm_up + 2 * args.spp, threads=1))
    for _ in range(args.warm_up):
        loop.step()
    start = time.process_time()
    plain = sum(loop.step().rays for _ in range(args.spp))
    plain = (time.process_time() - start) / plain
    threads = [cProfile.Profile(), cProfile.Profile()]
    loop.workers.submit(threads[0].enable).result()
    with threads[1]:
        rays = sum(loop.step().rays for _ in range(args.spp))
    loop.workers.submit(threads[0].disable).result()
    seconds: Counter[str] = Counter()
    for thread in threads:
        seconds += by_function(pstats.Stats(thread))
    samples = args.spp * scene.film.width * scene.film.height
    functions = Counter({name: 1e9 * value / rays for name, value in seconds.items()})
    return Profile(functions, rays / samples, 1e9 * plain)


def by_function(stats: pstats.Stats) -> Counter[str]:
    """Seconds in each function of the package; seconds of other functions count for their callers."""
    seconds: Counter[str] = Counter()
    for place, (_, _, own, _, callers) in stats.stats.items():
        if ours(place):
            seconds[named(place)] += own
        for caller, (_, _, spent, _) in callers.items() if not ours(place) else ():
            if ours(caller):
                seconds[named(caller)] += spent
    return seconds


def ours(place: tuple[str, int, str]) -> bool:
    return f"/{PACKAGE}/" in Path(place[0]).as_posix()


def named(place: tuple[str, int, str]) -> str:
    file, _, function = place
    return f"{Path(file).stem}.{function}"


if __name__ == "__main__":
    run(main)
