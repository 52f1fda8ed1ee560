"""All checks of a real GPU in one command of at most ten minutes: means, speed, host waits, memory and cost of the guide.

    python scripts/gpu_check.py --json gpu.json
    python scripts/gpu_check.py --device cpu --quick

Means: independent renders on the device and on a CPU have equal means over blocks of pixels and over the frame, in all modes
(Welch's t-test, Šidák's correction). Speed: steps between two CUDA events, after a warm-up. Host waits: operations for which
PyTorch's synchronisation debugger warns that the host waits. Guide: milliseconds of the phases of a step at 1920×1080, beside the
15 + 2 + 20 ms of the paper. `--device cpu` runs the same checks without a GPU, and shows that the script works.

Exit code 1 if a test of means fails.
"""

from __future__ import annotations

import argparse
import itertools
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy import stats
from torch.nn.functional import avg_pool2d

from bokehguide.cli.arguments import Parser
from bokehguide.cli.report import peak_memory_mb, write_json
from bokehguide.cli.scripts import run
from bokehguide.evaluation import markdown
from bokehguide.render.path_tracer import PathTracer
from bokehguide.runtime.device import check_device
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import MODES, RenderLoop, RenderSettings

SCENES = ("fairy-lights", "night-street", "chrome")
SPEED_MODES = ("uniform", "lis-o", "guided")
BLOCK = 16
LEVEL = 0.01
"""Level at which one call of the script in a hundred fails by chance."""
CPU_SEED = 1_000_000
"""Seed of the first render on the CPU."""
PAPER = {"fitting and guiding": 15.0, "blend weights": 2.0, "polynomials": 20.0}
"""Milliseconds per SPP at 1920×1080 that the paper reports on an RTX 4070."""


def main() -> int:
    args = parse()
    check_device(args.device)
    means = [compare_means(name, args) for name in SCENES[: 1 if args.quick else None]]
    rows = [row for scene in means for row in scene]
    speed = [measure(mode, args) for mode in SPEED_MODES]
    failed = sum(row["p"] < 1.0 - (1.0 - LEVEL) ** (1.0 / len(rows)) for row in rows)
    print(f"Means, {args.device} and CPU\n\n{table(rows)}\n\n{failed} of {len(rows)} tests fail\n")
    print(f"Steps at {'x'.join(map(str, frame_of(args)))}, {device_name(args.device)}\n\n{table(speed)}\n")
    paper = ", ".join(f"{name} {value:.0f} ms" for name, value in PAPER.items())
    print(f"Guide of the paper at 1920x1080: {paper}")
    if args.json:
        write_json(args.json, {"device": device_name(args.device), "means": rows, "steps": speed})
    return 1 if failed else 0


def parse() -> argparse.Namespace:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="the device to check (default: cuda)")
    parser.add_argument("--quick", action="store_true", help="one scene, few samples and a small frame")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the figures here")
    return parser.parse_args()


def compare_means(name: str, args: argparse.Namespace) -> list[dict]:
    """The tests of one scene, a row for each mode."""
    runs, spp = (4, 4) if args.quick else (12, 12)
    scene = load_scene(name, Overrides(width=96, height=54))
    tracers = {device: PathTracer(scene, torch.device(device)) for device in ("cpu", args.device)}
    rows = []
    for mode in MODES:
        settings = RenderSettings(mode, spp)
        ours = [render(scene, replace(settings, seed=seed, device=args.device), tracers) for seed in range(runs)]
        cpu = [render(scene, replace(settings, seed=CPU_SEED + seed), tracers) for seed in range(runs)]
        rows.append({"scene": name, "mode": mode, **welch(np.stack(ours), np.stack(cpu))})
    return rows


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


def measure(mode: str, args: argparse.Namespace) -> dict:
    """Speed, waits, memory and phases of one mode."""
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
    return row | {"host waits / step": waits, "device MiB": clock.memory_mb(), "process MiB": peak_memory_mb()}


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
