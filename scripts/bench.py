"""Speed of uniform and guided sampling: samples and rays per second, shares of a step, cost of the guide, peak memory.

    python scripts/bench.py --json bench.json
    python scripts/bench.py --peers
    python scripts/bench.py --aperture-radius 0.065

The modes take turns of TURN_SPP samples per pixel, so that other load of the machine affects all modes alike. Each turn begins
with the caches that the turn before has filled. Peak memory is measured in a process that renders one mode alone. With
`--peers` Mitsuba 3 takes turns too, and all render the scene with materials that both have (`mitsuba_scene.comparable`).
Mitsuba's first turn compiles and is not counted.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path

from bokehguide.cli.parser import natural, positive, size, threads
from bokehguide.cli.report import peak_memory_mb, write_json
from bokehguide.cli.scripts import run
from bokehguide.evaluation import markdown
from bokehguide.runtime.process import dedicate_process
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import RenderLoop, RenderSettings

MODES = ("uniform", "lis-o", "guided")
PEER = "Mitsuba"
TURN_SPP = 4
"""SPP of one turn of a mode and of Mitsuba."""
GUIDE_PHASES = ("guiding", "learning")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="fairy-lights")
    parser.add_argument("--size", type=size, default="1280x720", metavar="WxH", help="default: 1280x720")
    radius = "metres (default: the scene's); pixels of a wider lens have more candidates"
    parser.add_argument("--aperture-radius", type=float, metavar="M", help=radius)
    spp = f"measured steps of each mode, a multiple of {TURN_SPP} (default: 16)"
    parser.add_argument("--spp", type=positive, default=16, metavar="N", help=spp)
    warm_up = "steps before the measurement (default: 8, the steps of the global fit)"
    parser.add_argument("--warm-up", type=natural, default=8, metavar="N", help=warm_up)
    parser.add_argument("--threads", type=threads, metavar="N", help="default: one per core")
    parser.add_argument("--peers", action="store_true", help="compare with Mitsuba 3 (pip install '.[peers]')")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the figures here")
    args = parser.parse_args()
    if args.spp % TURN_SPP:
        parser.error(f"--spp {args.spp}: must be a multiple of {TURN_SPP}")
    if args.peers and importlib.util.find_spec("mitsuba") is None:
        parser.error("--peers: Mitsuba is not installed; pip install '.[peers]'")

    results = measure_speed(args)
    for mode in MODES:
        results[mode]["peak_memory_mb"] = measure_memory(mode, args)
    print(table(results, args))
    if args.json:
        write_json(args.json, results)


def table(results: dict[str, dict[str, float]], args: argparse.Namespace) -> str:
    """The figures in Markdown. Costs of a step and of its guide are in steps of uniform sampling."""
    lens = "" if args.aperture_radius is None else f", aperture radius {args.aperture_radius:g} m"
    title = f"{args.scene}{lens}, {'x'.join(map(str, args.size))}, {args.spp} SPP after {args.warm_up}"
    heads = [
        "M samples/s",
        "M rays/s",
        "in Embree",
        "in the guide",
        "candidates / pixel",
        "step / uniform's",
        "guide / uniform's step",
    ]
    rows = [["mode", *heads, "peak MiB"]]
    for mode in MODES:
        row = results[mode]
        rates = [f"{row[name] / 1e6:.3f}" for name in ("samples_per_second", "rays_per_second")]
        shares = [f"{row[name]:.1%}" for name in ("embree_share", "guide_share")]
        costs = [f"{row[name]:.2f}" for name in ("candidates", "step_cost", "guide_cost")]
        rows.append([mode, *rates, *shares, *costs, f"{row['peak_memory_mb']:.0f}"])
    if PEER in results:
        rows.append([PEER, f"{results[PEER]['samples_per_second'] / 1e6:.3f}", *[""] * len(heads)])
    return f"{title}\n\n{markdown(rows)}"


def measure_speed(args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Rates and shares of each mode over the measured steps, and the rate of Mitsuba with `--peers`."""
    loops = {mode: start(mode, args) for mode in MODES}
    peer = start_peer(args) if args.peers else None
    for loop in loops.values():
        for _ in range(args.warm_up):
            loop.step()
    before = {mode: dict(loop.phases) for mode, loop in loops.items()}
    steps, candidates = {mode: [] for mode in MODES}, dict.fromkeys(MODES, 0.0)
    peer_seconds = 0.0
    turns = args.spp // TURN_SPP
    for turn in range(turns):
        for mode, loop in loops.items():
            candidates[mode] += mean_candidates(loop) / turns
            steps[mode] += [loop.step() for _ in range(TURN_SPP)]
        if peer is not None:
            peer_seconds += peer(turn)
    results, uniform = {}, sum(stats.seconds for stats in steps["uniform"])
    if peer is not None:
        samples = args.spp * args.size[0] * args.size[1]
        results[PEER] = {"samples_per_second": samples / peer_seconds}
    for mode, loop in loops.items():
        seconds = sum(stats.seconds for stats in steps[mode])
        phases = {name: loop.phases[name] - before[mode][name] for name in loop.phases}
        results[mode] = {
            "samples_per_second": sum(stats.samples for stats in steps[mode]) / seconds,
            "rays_per_second": sum(stats.rays for stats in steps[mode]) / seconds,
            "embree_share": phases["tracing rays"] / seconds,
            "guide_share": sum(phases[name] for name in GUIDE_PHASES) / seconds,
            "step_cost": seconds / uniform,
            "guide_cost": sum(phases[name] for name in GUIDE_PHASES) / uniform,
            "candidates": candidates[mode],
        }
    return results


def mean_candidates(loop: RenderLoop) -> float:
    """Mean number of candidates of a pixel in the next step."""
    candidates = getattr(loop.mode.lens, "candidates", None)
    return 0.0 if candidates is None else float(candidates.counts().double().mean())


def measure_memory(mode: str, args: argparse.Namespace) -> float:
    """Peak MiB of a new process that renders the warm-up steps and two more."""
    with multiprocessing.get_context("spawn").Pool(1, dedicate_process) as pool:
        return pool.apply(render_alone, (mode, args))


def render_alone(mode: str, args: argparse.Namespace) -> float:
    loop = start(mode, args)
    for _ in range(args.warm_up + 2):
        loop.step()
    return peak_memory_mb() or math.nan


def start(mode: str, args: argparse.Namespace) -> RenderLoop:
    spp = args.warm_up + args.spp
    return RenderLoop(measured_scene(args), RenderSettings(mode=mode, spp=spp, threads=args.threads))


def measured_scene(args: argparse.Namespace) -> Scene:
    width, height = args.size
    scene = load_scene(args.scene, Overrides(width=width, height=height, aperture_radius=args.aperture_radius))
    if not args.peers:
        return scene
    from experiments.mitsuba_scene import comparable

    return comparable(scene)


def start_peer(args: argparse.Namespace) -> Callable[[int], float]:
    """A function of a seed that renders one of Mitsuba's turns and returns its seconds."""
    from experiments.mitsuba_scene import MitsubaRenderer

    renderer = MitsubaRenderer(measured_scene(args))

    def turn(seed: int) -> float:
        begun = time.perf_counter()
        renderer.picture(TURN_SPP, seed)
        return time.perf_counter() - begun

    turn(args.spp)
    return turn


if __name__ == "__main__":
    run(main)
