"""Where the time of a step goes, function by function.

    python scripts/profile_step.py --mode guided
    python scripts/profile_step.py --scene chrome --mode uniform --size 640x360 --compile

One thread renders; with `--compile` it does so again with compiled kernels, which are compiled first. What PyTorch, NumPy
and Embree do counts for the function that calls them. The profiler's own time, and waiting for a busy machine, are in all rows but
the last.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from collections import Counter
from pathlib import Path

from bokehguide.cli.arguments import Parser, natural, positive, size
from bokehguide.cli.scripts import run
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import MODES, RenderLoop, RenderSettings

PACKAGE = "bokehguide"
SHOWN = 40


def main() -> None:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="fairy-lights")
    parser.add_argument("--mode", choices=MODES, default="guided")
    parser.add_argument("--size", type=size, default="1280x720", metavar="WxH", help="default 1280x720")
    parser.add_argument("--spp", type=positive, default=4, help="profiled steps, default 4")
    parser.add_argument("--warm-up", type=natural, default=9, help="steps before them, default 9")
    parser.add_argument("--compile", action="store_true", help="profile compiled kernels beside eager ones")
    args = parser.parse_args()
    ways = {"eager": profiled(args, compiled=False)}
    if args.compile:
        ways["compiled"] = profiled(args, compiled=True)
    rays = ways["eager"][1]
    print(f"{args.scene} {args.mode} {'x'.join(map(str, args.size))}, one thread, {rays:.2f} rays a sample: ns a ray")
    print(f"{'':56}" + "".join(f"{way:>10}" for way in ways))
    for name, _ in sum((found[0] for found in ways.values()), Counter()).most_common(SHOWN):
        print(f"{name:56}" + "".join(f"{found[0][name]:10.1f}" for found in ways.values()))
    print(f"{'in all, without the profiler':56}" + "".join(f"{found[2]:10.1f}" for found in ways.values()))


def profiled(args: argparse.Namespace, compiled: bool) -> tuple[Counter[str], float, float]:
    """Nanoseconds a ray by function, rays a sample, and nanoseconds of processor time a ray of steps that are not profiled."""
    scene = load_scene(args.scene, Overrides(*args.size))
    loop = RenderLoop(scene, RenderSettings(args.mode, args.warm_up + 2 * args.spp, threads=1, compile=compiled))
    for _ in range(args.warm_up):
        loop.step()
    start = time.process_time()
    plain = sum(loop.step().rays for _ in range(args.spp))
    plain = (time.process_time() - start) / plain
    threads = [cProfile.Profile(), cProfile.Profile()]
    loop._pool.submit(threads[0].enable).result()
    with threads[1]:
        rays = sum(loop.step().rays for _ in range(args.spp))
    loop._pool.submit(threads[0].disable).result()
    seconds: Counter[str] = Counter()
    for thread in threads:
        seconds += by_function(pstats.Stats(thread))
    samples = args.spp * scene.film.width * scene.film.height
    return Counter({name: 1e9 * value / rays for name, value in seconds.items()}), rays / samples, 1e9 * plain


def by_function(stats: pstats.Stats) -> Counter[str]:
    """Seconds within each function of the package; those of other functions count for their callers."""
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
