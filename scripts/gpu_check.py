"""All checks of a real GPU in one command of at most ten minutes: means, speed, host waits, memory and cost of the guide.

    python scripts/gpu_check.py --json gpu.json
    python scripts/gpu_check.py --device cpu --quick

Means: independent renders on the device and on a CPU have equal means over blocks of pixels and over the frame, in all modes
(Welch's t-test, Šidák's correction). Processes share the renders, as a small frame occupies neither a GPU nor the cores.
Speed: steps at 1920×1080 between two CUDA events, after a warm-up, in one process after the other. Host waits: operations for
which PyTorch's synchronisation debugger warns that the host waits. Guide: differences between the steps of modes that differ in
one part, beside the 15 + 2 + 20 ms of the paper. `--device cpu` runs the same checks without a GPU, and shows that the script
works.

Exit code 1 if a test of means fails.
"""

from __future__ import annotations

import argparse
import itertools
import math
import multiprocessing
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy import stats
from torch.nn.functional import avg_pool2d
from tqdm import tqdm

from bokehguide.cli.parser import Parser
from bokehguide.cli.report import peak_memory_mb, write_json
from bokehguide.cli.scripts import run
from bokehguide.evaluation import markdown
from bokehguide.render.path_tracer import PathTracer
from bokehguide.runtime.device import check_device
from bokehguide.runtime.distributed import available_cores
from bokehguide.runtime.process import dedicate_process
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import MODES, RenderLoop, RenderSettings

SCENES = ("fairy-lights", "night-street", "chrome")
SPEED_MODES = ("uniform", "lis", "lis-b", "lis-o", "guided")
BLOCK = 16
LEVEL = 0.01
"""Level at which one call of the script in a hundred fails by chance."""
CPU_SEED = 1_000_000
"""Seed of the first render on the CPU."""
MOST_PROCESSES = 8
"""Largest number of processes that render small frames at the same time."""
PAPER = {
    ("lis", "uniform"): ("fitting and guiding", 15.0),
    ("lis-b", "lis"): ("blend weights", 2.0),
    ("lis-o", "lis-b"): ("polynomials", 20.0),
}
"""Parts of the paper's guide that one mode has beyond another, and their milliseconds per SPP at 1920×1080 on an RTX 4070."""


def main() -> int:
    args = parse()
    check_device(args.device)
    rows = all_means(args)
    failed = sum(row["p"] < 1.0 - (1.0 - LEVEL) ** (1.0 / len(rows)) for row in rows)
    print(f"Means, {args.device} and CPU\n\n{table(rows)}\n\n{failed} of {len(rows)} tests fail\n", flush=True)
    speed = all_steps(args)
    print(f"Steps at {'x'.join(map(str, frame_of(args)))}, {device_name(args.device)}\n\n{table(speed)}\n")
    guide = guide_parts(speed)
    print(f"Guide, milliseconds per SPP\n\n{table(guide)}")
    if args.json:
        write_json(args.json, {"device": device_name(args.device), "means": rows, "steps": speed, "guide": guide})
    return 1 if failed else 0


def parse() -> argparse.Namespace:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="the device to check (default: cuda)")
    parser.add_argument("--quick", action="store_true", help="one scene, few samples and a small frame")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the figures here")
    return parser.parse_args()


def all_means(args: argparse.Namespace) -> list[dict]:
    """Rows of the tests of means, from processes that render at the same time."""
    tasks = [(name, mode, args) for name in SCENES[: 1 if args.quick else None] for mode in modes_of(name)]
    tasks.sort(key=lambda task: not MODES[task[1]].whole_frame)  # the slow ones first
    processes = min(len(tasks), MOST_PROCESSES, max(available_cores() // 2, 1))
    with multiprocessing.get_context("spawn").Pool(processes, dedicate_process) as pool:
        rows = list(tqdm(pool.imap(compare_means, tasks), "means", len(tasks), unit="test"))
    return sorted(rows, key=lambda row: (SCENES.index(row["scene"]), [*MODES].index(row["mode"])))


def modes_of(scene: str) -> list[str]:
    """Modes to compare in a scene: the slow modes that resample the whole frame in the first scene alone."""
    return [mode for mode, entry in MODES.items() if scene == SCENES[0] or not entry.whole_frame]


def compare_means(task: tuple[str, str, argparse.Namespace]) -> dict:
    """The test of one mode in one scene."""
    name, mode, args = task
    runs, spp = (4, 4) if args.quick else (6, 3) if MODES[mode].whole_frame else (12, 12)
    scene = load_scene(name, Overrides(width=96, height=54))
    tracers = {device: PathTracer(scene, torch.device(device)) for device in ("cpu", args.device)}
    settings = RenderSettings(mode, spp, threads=1)
    ours = [render(scene, replace(settings, seed=seed, device=args.device), tracers) for seed in range(runs)]
    cpu = [render(scene, replace(settings, seed=CPU_SEED + seed), tracers) for seed in range(runs)]
    return {"scene": name, "mode": mode, **welch(np.stack(ours), np.stack(cpu))}


def render(scene: Scene, settings: RenderSettings, tracers: dict[str, PathTracer]) -> np.ndarray:
    """Mean luminance of each block and, last, of the frame."""
    with RenderLoop(scene, settings, tracer=tracers[settings.device]) as loop:
        for _ in range(settings.spp):
            loop.step()
        light = loop.film.radiance().cpu().double() @ torch.tensor((0.2126, 0.7152, 0.0722), dtype=torch.float64)
    blocks = avg_pool2d(light[None], BLOCK, ceil_mode=True, count_include_pad=False)
    return np.append(blocks.numpy().ravel(), light.mean())


def welch(ours: np.ndarray, others: np.ndarray) -> dict[str, float]:
    """Largest |t| over regions, and the p of all of them, from `[runs, regions]`."""
    differ = (ours.std(0) > 0.0) | (others.std(0) > 0.0) | (ours.mean(0) != others.mean(0))
    t, p = stats.ttest_ind(ours[:, differ], others[:, differ], equal_var=False)
    count = max(int(differ.sum()), 1)
    least = float(np.min(p, initial=1.0))
    return {"regions": count, "largest t": float(np.max(np.abs(t), initial=0.0)), "p": 1.0 - (1.0 - least) ** count}


def frame_of(args: argparse.Namespace) -> tuple[int, int]:
    return (192, 108) if args.quick else (1920, 1080)


def all_steps(args: argparse.Namespace) -> list[dict]:
    """Rows of the measurements of speed, one process after the other, so that each has its own peak memory."""
    rows = []
    for mode in tqdm(SPEED_MODES, "speed", unit="mode"):
        with multiprocessing.get_context("spawn").Pool(1, dedicate_process) as pool:
            rows.append(pool.apply(measure, (mode, args)))
    return rows


def guide_parts(speed: list[dict]) -> list[dict]:
    """Milliseconds of each part of the guide, here and in the paper."""
    step = {row["mode"]: row["ms / step"] for row in speed}
    parts = [{"part": name, "paper": paper, "here": step[more] - step[less]} for (more, less), (name, paper) in PAPER.items()]
    return [*parts, {"part": "all of guided", "paper": "", "here": step["guided"] - step["uniform"]}]


def measure(mode: str, args: argparse.Namespace) -> dict:
    """Speed, waits and memory of one mode, and phases by the clock of the host."""
    warm_up, spp = (2, 2) if args.quick else (8, 8)
    width, height = frame_of(args)
    scene = load_scene(SCENES[0], Overrides(width=width, height=height))
    with RenderLoop(scene, RenderSettings(mode, warm_up + spp + 1, device=args.device)) as loop:
        for _ in range(warm_up):
            loop.step()
        before, clock = dict(loop.phases), StepClock(args.device)
        steps = list(itertools.starmap(loop.step, [()] * spp))
        seconds = clock.seconds()
        phases = {name: 1e3 * (loop.phases[name] - before[name]) / spp for name in before}
        waits = host_waits(loop, args.device)
    row = {"mode": mode, "M samples/s": 1e-6 * sum(step.samples for step in steps) / seconds}
    row |= {"M rays/s": 1e-6 * sum(step.rays for step in steps) / seconds, "ms / step": 1e3 * seconds / spp}
    row |= {f"{name}, ms": value for name, value in phases.items()}
    return row | {"host waits / step": waits, "device MiB": clock.memory_mb(), "process MiB": peak_memory_mb() or math.nan}


class StepClock:
    """Time by CUDA events, or by the clock of the host without CUDA."""

    def __init__(self, device: str):
        self._cuda, self._start = device == "cuda", time.perf_counter()
        if self._cuda:
            torch.cuda.reset_peak_memory_stats()
            torch.cuda.synchronize()
            self._events = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            self._events[0].record()

    def seconds(self) -> float:
        """Since the start."""
        if not self._cuda:
            return time.perf_counter() - self._start
        self._events[1].record()
        torch.cuda.synchronize()
        return self._events[0].elapsed_time(self._events[1]) / 1e3

    def memory_mb(self) -> float:
        """Peak memory of the device, MiB."""
        return torch.cuda.max_memory_allocated() / 2**20 if self._cuda else 0.0


def host_waits(loop: RenderLoop, device: str) -> int:
    """Number of operations in one step for which the host waits for the device."""
    if device != "cuda":
        return 0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            loop.step()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(warning.message) for warning in caught)


def device_name(device: str) -> str:
    return torch.cuda.get_device_name() if device == "cuda" else "CPU"


def table(rows: list[dict]) -> str:
    heads = list(rows[0])
    return markdown(
        [heads, *([f"{row[head]:.3g}" if isinstance(row[head], float) else str(row[head]) for head in heads] for row in rows)]
    )


if __name__ == "__main__":
    run(main)
