"""Error over wall-clock time of bokehguide and of a peer, which is Mitsuba 3 or another mode: the same scene on the same machine.

    pip install '.[peers]'
    python scripts/equal_time.py --seconds 60 --out out/equal-time
    python scripts/equal_time.py daylight --size 320x180 --seconds 20
    python scripts/equal_time.py real-chess real-helmet --against uniform --size 320x180
    python scripts/equal_time.py fairy-lights --denoise

Against Mitsuba, both render the scene with materials that both have (`mitsuba_scene.comparable`). The pictures of real models
(`real_scenes.py`) have other materials, so that their peer is a mode. Both use all cores. They take turns of about a second, so
that other load of the machine affects both alike. The clock starts with the scene in memory: it includes the acceleration
structure and compilation, and excludes the measurement of errors.

With `--denoise`, errors are measured after 1, 2, 4, … seconds and at the end, and both pictures are denoised before. A mode's
picture is that of `bokehguide render --denoise`. Mitsuba's comes from the same denoiser, with albedo and normals of Mitsuba.
The clock excludes denoising.

The reference is rendered in mode `guided`, in two halves, and kept in `--cache`. Its own error is part of both errors, and the
table shows its estimate. Writes equal_time.json, equal_time.md and equal_time.png: MAPE at 1, 2, 4, … seconds, and the ratio.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from real_scenes import load_any
from torch import Tensor

from bokehguide.cli.parser import Parser, duration, positive, size, threads
from bokehguide.cli.report import write_json
from bokehguide.cli.scripts import run
from bokehguide.evaluation import errors, made_reference, markdown, progress, regions
from bokehguide.image import check_writable, write_text
from bokehguide.image.oidn import Denoiser, require_denoiser
from bokehguide.scene import Scene
from bokehguide.train import LENS_MODES, RenderLoop, RenderSettings, denoise_picture

SCENES = ("fairy-lights", "night-street", "chrome", "daylight")
TURN = 1.0
"""Seconds of a turn."""
MITSUBA = "mitsuba"
SEED = 5_000_000
"""Seed of the measured renders; no reference has it."""


@dataclass
class Runner:
    """One renderer: `advance` renders some more SPP and returns their number, `picture` returns the mean so far.

    With `--denoise`, `picture` returns the denoised mean.
    seconds, spp: so far; history: seconds, SPP and MAPE by region after each measured turn.
    """

    name: str
    advance: Callable[[], int]
    picture: Callable[[], Tensor]
    seconds: float = 0.0
    spp: int = 0
    history: list[dict] = field(default_factory=list)

    def turn(self) -> None:
        """Render for about TURN seconds."""
        end = self.seconds + TURN
        while self.seconds < end:
            start = time.perf_counter()
            self.spp += self.advance()
            self.seconds += time.perf_counter() - start

    def measure(self, reference: Tensor, masks: dict[str, Tensor]) -> None:
        """Record the errors of the picture so far."""
        picture = self.picture()
        found = {name: errors(picture, reference, mask)["mape"] for name, mask in masks.items()}
        self.history.append({"seconds": self.seconds, "spp": self.spp, "mape": found})

    def at(self, seconds: float, region: str) -> tuple[float, int] | None:
        """MAPE and SPP of the last turn that ended by then."""
        ended = [turn for turn in self.history if turn["seconds"] <= seconds]
        return (ended[-1]["mape"][region], ended[-1]["spp"]) if ended else None


@dataclass(frozen=True)
class Race:
    """Both renderers after their race. reference_error: estimated MAPE of the reference by region."""

    own: Runner
    peer: Runner
    reference_error: dict[str, float]

    def facts(self) -> dict[str, object]:
        """The content of equal_time.json."""
        return {one.name: one.history for one in (self.own, self.peer)} | {"reference_error": self.reference_error}


def main() -> None:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("scenes", nargs="*", default=list(SCENES), metavar="SCENE", help=f"default: {', '.join(SCENES)}")
    add("--against", choices=(MITSUBA, *LENS_MODES), default=MITSUBA, help="the peer (default: mitsuba)")
    add("--mode", choices=LENS_MODES, default="guided", help="of bokehguide (default: guided)")
    add("--denoise", action="store_true", help="compare denoised pictures")
    add("--size", type=size, default="640x360", metavar="WxH", help="default: 640x360")
    add("--seconds", type=duration, default=60.0, metavar="S", help="seconds of each renderer (default: 60)")
    add("--reference-spp", type=positive, default=4096, metavar="N", help="SPP of the reference (default: 4096)")
    add("--threads", type=threads, metavar="N", help="threads of bokehguide (default: one per core); Mitsuba uses all cores")
    add("--cache", type=Path, metavar="DIR", help="folder of the references (default: the user's cache folder)")
    add("--out", type=Path, default=Path("out/equal-time"), metavar="DIR", help="folder of the results (default: out/equal-time)")
    args = parser.parse_args()
    if args.against == MITSUBA and importlib.util.find_spec("mitsuba") is None:
        sys.exit("equal_time: error: Mitsuba is not installed; pip install '.[peers]', or give --against a mode")
    if args.denoise:
        require_denoiser()
    check_writable(args.out / "equal_time.json")
    scenes = [load_any(name, *args.size) for name in args.scenes]
    races: dict[str, Race] = {}
    for scene in scenes:
        races[scene.name] = race(scene, args)
        write_results(races, args)
    print(table(races, args.seconds))


def race(scene: Scene, args: argparse.Namespace) -> Race:
    """Both runners with their histories. Each inset has its own row if the peer is a mode."""
    if args.against == MITSUBA:
        from experiments.mitsuba_scene import comparable

        scene = comparable(scene)
    settings = RenderSettings(spp=args.reference_spp, threads=args.threads)
    reference = made_reference(scene, settings, args.out / f"{scene.name}-reference.exr", args.cache)
    masks = {name: mask for name, mask in regions(scene).items() if args.against != MITSUBA or name in ("frame", "insets")}
    peer = mitsuba_runner(scene, args.denoise) if args.against == MITSUBA else mode_runner(scene, args.against, args)
    runners = [mode_runner(scene, args.mode, args), peer]
    with progress(f"{scene.name}, {args.seconds:g} s of each", round(args.seconds / TURN), unit="turn") as bar:
        # A renderer whose start takes longer has one turn all the same.
        while unfinished := [one for one in runners if one.seconds < args.seconds or not one.history]:
            for runner in unfinished:
                before = runner.seconds
                runner.turn()
                if not args.denoise or reached(before, runner.seconds, args.seconds):
                    runner.measure(reference.radiance, masks)
            bar.update()
    return Race(*runners, {region: reference.halves[region]["mape"] / 2 for region in masks})


def reached(before: float, after: float, end: float) -> bool:
    """Whether 1, 2, 4, … seconds or the end lie after `before` and not after `after`."""
    return after >= min(end, 2.0 ** (math.floor(math.log2(max(before, 0.5))) + 1))


def mode_runner(scene: Scene, mode: str, args: argparse.Namespace) -> Runner:
    start = time.perf_counter()
    loop = RenderLoop(scene, RenderSettings(mode, 1 << 20, SEED, threads=args.threads, denoise=args.denoise))
    built = time.perf_counter() - start

    def advance() -> int:
        loop.step()
        return 1

    def picture() -> Tensor:
        return torch.from_numpy(denoise_picture(loop.film).radiance) if args.denoise else loop.film.radiance().cpu()

    return Runner(mode, advance, picture, built)


def mitsuba_runner(scene: Scene, denoise: bool) -> Runner:
    from experiments.mitsuba_scene import CHUNK_SAMPLES, MitsubaRenderer

    start = time.perf_counter()
    renderer = MitsubaRenderer(scene, layers=denoise)
    built = time.perf_counter() - start
    total = torch.zeros(scene.film.height, scene.film.width, 9 if denoise else 3, dtype=torch.float64)
    most = max(1, CHUNK_SAMPLES // (scene.film.width * scene.film.height))
    done = 0

    def advance() -> int:
        nonlocal done
        spp = max(1, min(done, most))  # 1, 1, 2, 4, …: an early first picture, then few launches
        total.add_(renderer.picture(spp, SEED + done), alpha=spp)
        done += spp
        return spp

    def picture() -> Tensor:
        radiance, *layers = (total / done).float().numpy().reshape(*total.shape[:2], -1, 3).transpose(2, 0, 1, 3)
        return torch.from_numpy(Denoiser(*layers)(radiance) if denoise else radiance)

    return Runner("Mitsuba", advance, picture, built)


def write_results(races: dict[str, Race], args: argparse.Namespace) -> None:
    """Write the files of the races so far, so that an end between two scenes loses none."""
    write_json(args.out / "equal_time.json", {name: each.facts() for name, each in races.items()})
    write_text(args.out / "equal_time.md", table(races, args.seconds) + "\n")
    draw(races, args.out / "equal_time.png")


def table(races: dict[str, Race], seconds: float) -> str:
    """MAPE of both at 1, 2, 4, … seconds and at the end, in Markdown."""
    times = [2.0**power for power in range(20) if 2.0**power < seconds] + [seconds + 2.0 * TURN]
    peer = next(iter(races.values())).peer.name
    rows = [["scene", "region", "seconds", "MAPE", "SPP", f"MAPE of {peer}", "SPP", "ratio", "error of the reference"]]
    for name, each in races.items():
        for region, error in each.reference_error.items():
            for limit in times:
                one, other = each.own.at(limit, region), each.peer.at(limit, region)
                if one and other:
                    found = [text for mape, spp in (one, other) for text in (f"{mape:.4f}", str(spp))]
                    rows.append([name, region, f"{min(limit, seconds):g}", *found, f"{one[0] / other[0]:.3f}", f"{error:.4f}"])
    return markdown(rows)


def draw(races: dict[str, Race], path: Path) -> None:
    """MAPE over seconds on log axes, a column for each scene and a row for each region."""
    from matplotlib.figure import Figure

    from bokehguide.evaluation.curves_figure import label
    from bokehguide.evaluation.page import NORMAL, SMALL, WIDTH, save

    figure = Figure(figsize=(WIDTH, 0.55 * WIDTH), layout="constrained")
    axes = figure.subplots(2, len(races), squeeze=False)
    for column, (name, each) in enumerate(races.items()):
        for axis, region in zip(axes[:, column], ("insets", "frame")):
            for runner in (each.own, each.peer):
                line = [(turn["seconds"], turn["mape"][region]) for turn in runner.history if region in turn["mape"]]
                if line:
                    axis.loglog(*zip(*line), label=runner.name)
            axis.set_title(f"{name}, {region}", fontsize=SMALL)
            label(axis.xaxis)
            label(axis.yaxis)
            axis.tick_params(labelsize=SMALL, which="both")
            axis.grid(alpha=0.3, which="both")
    for axis in axes[-1]:
        axis.set_xlabel("seconds", fontsize=NORMAL)
    for axis in axes[:, 0]:
        axis.set_ylabel("MAPE", fontsize=NORMAL)
    figure.legend(*axes[-1, 0].get_legend_handles_labels(), fontsize=SMALL, loc="outside upper center", ncols=2)
    save(figure, path)


if __name__ == "__main__":
    run(main)
