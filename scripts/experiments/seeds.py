"""Modes over several seeds at equal SPP or equal time: errors with confidence intervals, and block by block.

    python scripts/experiments/seeds.py
    python scripts/experiments/seeds.py night-street --modes uniform,lis-o,guided --seeds 8 --spp 64
    python scripts/experiments/seeds.py real-chess --modes uniform,guided --equal-time

Each mode is rendered with several seeds. With `--equal-time`, the last mode has the SPP of `--spp`, and the other modes have its
seconds with each seed, from the building of the acceleration structure on. The table has SPP, rays per sample, MAPE and relMSE
over the insets (over the frame for a scene without insets), averaged over the seeds. It also has the errors of the last mode over
the errors of each other mode, with 95 % intervals (Student's t of the differences of logarithms). A sentence below the table
compares blocks of 32 × 32 pixels: the worst ratio of the last mode's relMSE to the first mode's, and the number of blocks above
WORSE with 95 % confidence for all blocks at once (Bonferroni).

Writes seeds.md, and for each scene SCENE-first.png: the last mode at 8 SPP beside the first mode at 8 and at 256 SPP.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from scipy import stats
from torch import Tensor
from torch.nn.functional import avg_pool2d

sys.path.insert(0, str(Path(__file__).parents[1]))

from experiments.options import experiment_parser, load_scenes

from bokehguide.cli.parser import positive
from bokehguide.cli.scripts import run
from bokehguide.evaluation import errors, made_reference, progress, regions, whole_step
from bokehguide.image import check_writable, tone_map, write_png, write_text
from bokehguide.metrics import EPSILON
from bokehguide.scene import Scene
from bokehguide.train import RenderLoop, RenderSettings

FIRST_SEED = 6_000_000
REFERENCE_SHARE = 16
"""SPP of a reference per SPP of a render."""
BLOCK, WORSE = 32, 1.1
EARLY, LATE = 8, 256


def main() -> None:
    parser = experiment_parser(__doc__, "320x180", "uniform,lis-o,guided")
    parser.add_argument("--spp", type=positive, default=64, metavar="N", help="default: 64")
    parser.add_argument("--equal-time", action="store_true", help="give each other mode the seconds of the last mode")
    parser.add_argument("--seeds", type=positive, default=8, metavar="N", help="renders of each mode (default: 8)")
    parser.add_argument("--cache", type=Path, metavar="DIR", help="folder of the references (default: the user's cache folder)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/seeds"), metavar="DIR", help="folder of the results (default: out/seeds)"
    )
    args = parser.parse_args()
    check_writable(args.out / "seeds.md")
    lines = []
    for scene in load_scenes(args):
        table = [*report(scene, args), ""]
        print("\n".join(table), flush=True)
        lines += table
        write_text(args.out / "seeds.md", "\n".join(lines) + "\n")
        early_picture(scene, args)


def report(scene: Scene, args: argparse.Namespace) -> Iterator[str]:
    """Lines of the table of one scene and of the sentence on its blocks."""
    settings = RenderSettings(spp=args.spp, threads=args.threads)
    path = args.out / f"{scene.name}-reference.exr"
    reference = made_reference(scene, replace(settings, spp=REFERENCE_SHARE * args.spp), path, args.cache).radiance.float()
    masks = regions(scene)
    mask = masks.get("insets", masks["frame"])
    done = rendered(scene, settings, args)
    found = {mode: measured(renders.pictures, reference, mask) for mode, renders in done.items()}
    last = args.modes[-1]
    yield f"| {scene.name} | SPP | rays per sample | MAPE | relMSE | MAPE of {last} over it | relMSE of {last} over it |"
    yield "| --- | ---: | ---: | ---: | ---: | ---: | ---: |"
    for mode, values in found.items():
        means = " | ".join(f"{value:.4f}" for value in values.mean(0).tolist())
        ratios = " | ".join(interval(found[last][:, column], values[:, column]) for column in range(2))
        spp, rays = done[mode].spp / args.seeds, done[mode].rays / done[mode].samples
        yield f"| {mode} | {spp:.0f} | {rays:.2f} | {means} | {ratios if mode != last else '1 | 1'} |"
    yield ""
    yield blocks(done[last].pictures, done[args.modes[0]].pictures, reference, args.modes)


@dataclass
class Renders:
    """Renders of one mode with several seeds. pictures: radiance `[H, W, 3]` of each; spp, rays, samples: of all together."""

    pictures: list[Tensor] = field(default_factory=list)
    spp: int = 0
    rays: int = 0
    samples: int = 0

    def add(self, scene: Scene, settings: RenderSettings, limit: float | None = None) -> float:
        """Render `settings.spp` SPP or, with a limit, as many as it has seconds for. Returns the seconds of the render."""
        start = time.perf_counter()
        with RenderLoop(scene, settings) as loop:
            while time.perf_counter() - start < limit if limit else loop.step_number < settings.spp:
                stats = whole_step(loop)
                self.rays, self.samples = self.rays + stats.rays, self.samples + stats.samples
            seconds = time.perf_counter() - start
            self.pictures.append(loop.film.radiance().cpu())
            self.spp += loop.step_number
        return seconds


def rendered(scene: Scene, settings: RenderSettings, args: argparse.Namespace) -> dict[str, Renders]:
    """The renders of all modes at seeds from FIRST_SEED on. For each seed, the last mode comes first."""
    done = {mode: Renders() for mode in args.modes}
    with progress(scene.name, args.seeds * len(done), unit="render") as bar:
        for seed in range(FIRST_SEED, FIRST_SEED + args.seeds):
            limit = None
            for mode in reversed(args.modes):
                seconds = done[mode].add(scene, replace(settings, mode=mode, seed=seed), limit)
                if args.equal_time and mode == args.modes[-1]:
                    limit = seconds
                bar.update()
    return done


def measured(images: list[Tensor], reference: Tensor, mask: Tensor) -> Tensor:
    """MAPE and relMSE of each image over the mask, `[seeds, 2]`."""
    return torch.tensor([list(errors(image, reference, mask).values()) for image in images])


def interval(ours: Tensor, others: Tensor) -> str:
    """Quotient of two means over seeds, with its 95 % interval."""
    if len(ours) == 1:
        return f"{float(ours / others):.3f}"
    ratio = float(ours.mean() / others.mean())
    spread = stats.t.ppf(0.975, 2 * len(ours) - 2) * log_error(ours, others)
    return f"{ratio:.3f} ({ratio * math.exp(-spread):.3f} … {ratio * math.exp(spread):.3f})"


def log_error(ours: Tensor, others: Tensor) -> Tensor:
    """Standard error of the logarithm of the quotient of two means over seeds `[seeds, ..]`."""
    return sum(values.var(0) / values.mean(0).square() / len(values) for values in (ours, others)).sqrt()


def blocks(ours: list[Tensor], others: list[Tensor], reference: Tensor, modes: list[str]) -> str:
    """The sentence on the relMSE of blocks."""
    if len(ours) == 1:
        return "Blocks are compared over two seeds or more."
    one, other = (torch.stack([by_block(image, reference) for image in images]) for images in (ours, others))
    ratio = (one.mean(0) / other.mean(0).clamp(min=1e-12)).double()
    quantile = stats.t.ppf(1.0 - 0.05 / len(ratio), 2 * len(ours) - 2)
    worse = int((ratio * torch.exp(-quantile * log_error(one, other).double()) > WORSE).sum())
    return (
        f"Of {len(ratio)} blocks of {BLOCK} x {BLOCK} pixels, the relMSE of {modes[-1]} over that of {modes[0]} is "
        f"{ratio.max():.2f} in the worst and {ratio.median():.3f} in the median. "
        f"Of these ratios, {int((ratio > WORSE).sum())} are above {WORSE}, {worse} of them with 95 % confidence."
    )


def by_block(image: Tensor, reference: Tensor) -> Tensor:
    """relMSE of each block, `[blocks]`; blocks at the right and lower edge may be smaller."""
    squares = ((image - reference) / (reference + EPSILON)).square().mean(2)
    return avg_pool2d(squares[None, None], BLOCK, ceil_mode=True, count_include_pad=False).flatten()


def early_picture(scene: Scene, args: argparse.Namespace) -> None:
    """Write the last mode at EARLY SPP beside the first mode at EARLY and at LATE SPP."""
    early = Renders()
    for mode, spp in ((args.modes[-1], EARLY), (args.modes[0], EARLY), (args.modes[0], LATE)):
        early.add(scene, RenderSettings(mode, spp, FIRST_SEED, threads=args.threads))
    write_png(args.out / f"{scene.name}-first.png", tone_map(torch.cat(early.pictures, dim=1)))


if __name__ == "__main__":
    run(main, "tables of finished scenes are kept")
