"""Cost of a step and memory as the numbers of pixels, triangles, emitters and SPP grow.

    python scripts/experiments/scaling.py --out out/scaling
    python scripts/experiments/scaling.py --modes guided --emitters 10,100,1000

One of the four numbers grows while the others keep the values of BASE. The scene is a field of hills in focus; the emitters
lie far behind it, each of eight triangles. Every row comes from a process of its own: seconds from the scene to the first
picture, median seconds of STEPS later steps, peak memory, and the memory of the guide. Writes scaling.json, scaling.md and
scaling.png. The last column is the exponent of the step's seconds from the row before.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import statistics
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from experiments.options import numbers

from bokehguide.cli.parser import modes, threads
from bokehguide.cli.report import peak_memory_mb, write_json
from bokehguide.cli.scripts import run
from bokehguide.evaluation.tables import markdown
from bokehguide.image import check_writable, write_text
from bokehguide.runtime.process import dedicate_process
from bokehguide.scene import Camera, Environment, FilmSettings, Material, Mesh, Scene
from bokehguide.train import RenderLoop, RenderSettings

STEPS = 3
"""Number of measured steps; the table has their median."""
WARM_UP = 8
"""Steps before the measured ones: those of the paper's global fit."""
BASE = {"pixels": 500_000, "triangles": 100_000, "emitters": 100, "spp": WARM_UP}
"""Values of the numbers that do not grow."""
GROWING = {
    "pixels": (100_000, 500_000, 2_000_000, 8_000_000),
    "triangles": (1_000, 10_000, 100_000, 1_000_000, 5_000_000),
    "emitters": (10, 100, 1_000, 10_000),
    "spp": (8, 64, 512),
}
MATERIALS = (
    Material("hills", (0.5, 0.45, 0.4), roughness=0.6),
    Material("emitter", (0.0, 0.0, 0.0), specular=0.0, emission=(1.0, 0.8, 0.5)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--modes", type=modes, default=["uniform", "guided"], metavar="A,B,...", help="default: uniform,guided")
    for name, values in GROWING.items():
        shown = ",".join(map(str, values))
        parser.add_argument(f"--{name}", type=numbers, default=list(values), metavar="N,N,...", help=f"default: {shown}")
    parser.add_argument("--threads", type=threads, metavar="N", help="default: one per core")
    parser.add_argument(
        "--out", type=Path, default=Path("out/scaling"), metavar="DIR", help="folder of the results (default: out/scaling)"
    )
    args = parser.parse_args()
    check_writable(args.out / "scaling.json")
    rows = []
    for growing in GROWING:
        for mode in args.modes:
            for value in getattr(args, growing):
                rows.append({"mode": mode, "growing": growing, **measured(mode, BASE | {growing: value}, args.threads)})
                print(f"{mode} {growing} {value}: {rows[-1]['step']:.3f} s", file=sys.stderr)
    write_json(args.out / "scaling.json", {"rows": rows})
    text = table(rows)
    write_text(args.out / "scaling.md", text + "\n")
    print(text)
    draw(rows, args.out / "scaling.png")


def measured(mode: str, amounts: dict[str, int], workers: int | None) -> dict[str, float]:
    """The costs of a render in a new process."""
    with multiprocessing.get_context("spawn").Pool(1, dedicate_process) as pool:
        return amounts | pool.apply(costs, (mode, amounts, workers))


def costs(mode: str, amounts: dict[str, int], workers: int | None) -> dict[str, float]:
    """first: seconds from the scene to the first step's end; step: of a later one; MiB of the process, the guide, its record."""
    scene = hills(amounts["pixels"], amounts["triangles"], amounts["emitters"])
    start = time.perf_counter()
    loop = RenderLoop(scene, RenderSettings(mode, amounts["spp"] + STEPS, threads=workers))
    loop.step()
    first = time.perf_counter() - start
    while loop.step_number < amounts["spp"]:
        loop.step()
    step = statistics.median(loop.step().seconds for _ in range(STEPS))
    guide, record = guide_memory(loop)
    return {"first": first, "step": step, "memory_mb": peak_memory_mb() or math.nan, "guide_mb": guide, "record_mb": record}


def guide_memory(loop: RenderLoop) -> tuple[float, float]:
    """MiB of the lens and light strategies with their optimisers and candidates, and of the record buffer alone."""
    lens, lights = loop.mode.lens, loop.mode.lights
    tensors = [*lens.state_dict().values(), *lights.state_dict().values()]
    tensors += [value for one in lens.optimizers.values() for state in one.state.values() for value in state.values()]
    candidates, record = getattr(lens, "candidates", None), getattr(lens, "record_buffer", None)
    tensors += [] if candidates is None else [candidates.start, candidates.gaussian]
    return mebibytes(tensors), 0.0 if record is None else mebibytes(record.state_dict().values())


def mebibytes(tensors: Iterable[Tensor]) -> float:
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors) / 2**20


def hills(pixels: int, triangles: int, emitters: int) -> Scene:
    """The scene, with about these numbers of pixels and triangles of hills, and this number of emitters."""
    height = max(round(math.sqrt(pixels * 9 / 16)), 1)
    camera = Camera((0.0, 1.2, 4.0), (0.0, 0.6, 0.0), fov=45.0, aperture_radius=0.08, focus_distance=4.0)
    sky = Environment(np.full((1, 1, 3), 0.05, np.float32))
    meshes = (terrain(max(round(math.sqrt(triangles / 2)), 1)), octahedra(emitters))
    return Scene("hills", camera, meshes, lit(emitters), FilmSettings(round(height * 16 / 9), height), sky)


def lit(emitters: int) -> tuple[Material, ...]:
    """The materials; all emitters together have the same power for every number of emitters."""
    surface, emitter = MATERIALS
    scale = 2e5 / emitters
    return surface, Material(emitter.name, emitter.base_color, specular=0.0, emission=tuple(scale * c for c in emitter.emission))


def terrain(side: int) -> Mesh:
    """Waves over 8 × 8 m in side × side squares of two triangles."""
    line = np.linspace(-4.0, 4.0, side + 1)
    x, z = np.meshgrid(line, line)
    y = 0.15 * (np.sin(3.0 * x) + np.cos(2.0 * z + x))
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    below = corner + side + 1
    triangles = np.concatenate((np.stack((corner, below, corner + 1), 1), np.stack((corner + 1, below, below + 1), 1)))
    return Mesh(np.stack((x, y, z), -1).reshape(-1, 3).astype(np.float32), triangles.astype(np.int32), 0)


def octahedra(count: int) -> Mesh:
    """Emitters of 4 mm radius in a random cloud behind the hills."""
    rng = np.random.default_rng(7)
    centre = rng.uniform((-6.0, 0.2, -9.0), (6.0, 4.0, -5.0), (count, 3))
    corners = 0.004 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    vertices = (centre[:, None] + corners).reshape(-1, 3).astype(np.float32)
    return Mesh(vertices, (faces + 6 * np.arange(count)[:, None, None]).reshape(-1, 3).astype(np.int32), 1)


def table(rows: list[dict]) -> str:
    """All rows in Markdown."""
    cells = [
        ["mode", "growing", "number", "first picture s", "step s", "ns per sample", "MiB", "guide MiB", "record MiB", "exponent"]
    ]
    before: dict | None = None
    for row in rows:
        along = before is not None and (before["mode"], before["growing"]) == (row["mode"], row["growing"])
        power = math.log(row["step"] / before["step"]) / math.log(value(row) / value(before)) if along else math.nan
        numbers_ = (f"{row['first']:.2f}", f"{row['step']:.3f}", f"{row['step'] / row['pixels'] * 1e9:.0f}")
        memory = (f"{row[name]:.0f}" for name in ("memory_mb", "guide_mb", "record_mb"))
        cells.append([row["mode"], row["growing"], f"{value(row):,}", *numbers_, *memory, f"{power:.2f}" if along else ""])
        before = row
    return markdown(cells)


def value(row: dict) -> int:
    """The growing number of a row."""
    return row[row["growing"]]


def draw(rows: list[dict], path: Path) -> None:
    """Seconds of a step and memory over each growing number, on log axes."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, NullLocator

    from bokehguide.evaluation.curves_figure import label
    from bokehguide.evaluation.page import NORMAL, SMALL, WIDTH, save

    figure = Figure(figsize=(WIDTH, 0.55 * WIDTH), layout="constrained")
    axes = figure.subplots(2, len(GROWING))
    for column, growing in enumerate(GROWING):
        for mode in dict.fromkeys(row["mode"] for row in rows):
            line = [row for row in rows if (row["mode"], row["growing"]) == (mode, growing)]
            for axis, name in zip(axes[:, column], ("step", "memory_mb")):
                axis.loglog([value(row) for row in line], [row[name] for row in line], "o-", label=mode, markersize=3)
        axes[1, column].set_xlabel(growing, fontsize=NORMAL)
        for axis in axes[:, column]:
            axis.set_xticks(sorted({value(row) for row in rows if row["growing"] == growing}))
            axis.xaxis.set_major_formatter(EngFormatter(sep=""))
            axis.xaxis.set_minor_locator(NullLocator())
    for axis in axes.flat:
        label(axis.yaxis)
        axis.tick_params(labelsize=SMALL, which="both")
        axis.grid(alpha=0.3, which="both")
    axes[0, 0].set_ylabel("seconds per step", fontsize=NORMAL)
    axes[1, 0].set_ylabel("peak MiB", fontsize=NORMAL)
    axes[0, 0].legend(fontsize=SMALL)
    save(figure, path)


if __name__ == "__main__":
    run(main)
