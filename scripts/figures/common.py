"""Options, comparisons and output files of the figure scripts.

Renders go into a folder for each scene under `--out`, and all figures share them: no render is made twice. References are
kept in `--cache`. Each figure script writes PNG pictures, the numbers as JSON and their table in Markdown.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bokehguide.cli.parser import Parser, positive, size, threads
from bokehguide.evaluation import Comparison, compare, made_reference, markdown, summary
from bokehguide.evaluation.comparison import SEED
from bokehguide.guiding.config import GaussianConfig
from bokehguide.image import check_writable, write_text
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import RenderSettings

REFERENCE_SHARE = 16
"""SPP of a reference per SPP of a mode, the same as in `compare`."""
PAPER_WIDTH, PAPER_RADIUS = 1920, 50
"""Pixels: width of the paper's pictures, and Area ReSTIR's radius of neighbours in them. The radius scales with the width."""


@dataclass(frozen=True)
class Variant:
    """A mode rendered with other settings or fewer SPP, kept in a folder of its own.

    gaussian: settings of the mode; spp_divisor: divides the SPP of a mode that costs many times the others.
    """

    label: str
    mode: str
    folder: str
    gaussian: GaussianConfig = GaussianConfig()
    spp_divisor: int = 1


def figure_options(
    doc: str, scenes: Sequence[str], add_more: Callable[[Parser], None] = lambda parser: None
) -> argparse.Namespace:
    """The command line of a figure; makes the output folder.

    scenes: the default scenes; add_more: adds the options of this figure alone.
    """
    parser = Parser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_more(parser)
    add = parser.add_argument
    add("scenes", nargs="*", default=list(scenes), metavar="SCENE", help=f"default: {', '.join(scenes)}")
    add("--size", type=size, default="320x180", metavar="WxH", help="default: 320x180")
    add("--spp", type=positive, default=64, metavar="N", help="SPP of each mode (default: 64)")
    add("--threads", type=threads, metavar="N", help="default: one per core")
    add("--cache", type=Path, metavar="DIR", help="folder of the references (default: the user's cache folder)")
    add("--out", type=Path, default=Path("out/figures"), metavar="DIR", help="folder of the results (default: out/figures)")
    options = parser.parse_args()
    check_writable(options.out / "figure")
    return options


def compared(shown: Sequence[str | Variant], options: argparse.Namespace) -> list[Comparison]:
    """Modes and variants on each scene against a reference; renders only the missing ones."""
    return [_compared(name, shown, options) for name in options.scenes]


def _compared(name: str, shown: Sequence[str | Variant], options: argparse.Namespace) -> Comparison:
    scene = sized(name, options)
    folder = options.out / scene.name
    whole = RenderSettings(spp=REFERENCE_SHARE * options.spp, threads=options.threads)
    reference = made_reference(scene, whole, folder / "reference.exr", options.cache)
    modes = [settings(mode, options) for mode in shown if isinstance(mode, str)]
    plain = compare(scene, modes, reference, folder)
    runs, images = dict(plain.runs), dict(plain.images)
    for variant in shown:
        if isinstance(variant, Variant):
            spp = max(1, options.spp // variant.spp_divisor)
            changed = replace(modes[0], mode=variant.mode, spp=spp, gaussian=variant.gaussian)
            one = compare(scene, [changed], reference, folder / variant.folder)
            runs[variant.label], images[variant.label] = one.runs[variant.mode], one.images[variant.mode]
    labels = [one.label if isinstance(one, Variant) else one for one in shown]
    chosen = ({label: found[label] for label in labels} for found in (runs, images))
    return Comparison(scene, modes[0], reference, *chosen, plain.over_uniform)


def sized(name: str, options: argparse.Namespace) -> Scene:
    """A scene at the figure's size."""
    width, height = options.size
    return load_scene(name, Overrides(width=width, height=height))


def settings(mode: str, options: argparse.Namespace) -> RenderSettings:
    """Settings of a mode in all figures."""
    radius = max(1.0, PAPER_RADIUS * options.size[0] / PAPER_WIDTH)
    return RenderSettings(mode, options.spp, SEED, threads=options.threads, reuse_radius=radius)


def relabelled(comparison: Comparison, labels: Mapping[str, str]) -> Comparison:
    """The comparison with other names of its columns."""
    renamed = [{labels.get(name, name): found for name, found in one.items()} for one in (comparison.runs, comparison.images)]
    return replace(comparison, runs=renamed[0], images=renamed[1])


def write_numbers(comparisons: Sequence[Comparison], path: Path, more: Mapping[str, Mapping] | None = None) -> None:
    """The numbers of a figure as JSON, and the MAPE by region as a Markdown table beside it. more: further numbers by scene."""
    scenes = {
        comparison.scene.name: {
            "reference": comparison.reference.facts(),
            **summary(comparison),
            **(more or {}).get(comparison.scene.name, {}),
        }
        for comparison in comparisons
    }
    write_json(scenes, path)
    write_table([errors_table(comparison) for comparison in comparisons], path)


def errors_table(comparison: Comparison) -> str:
    """MAPE of each column and of the reference by region, with the ratio to the first column, and rays per sample."""
    scene, runs = comparison.scene, comparison.runs
    shown = [region for region in next(iter(runs.values())).errors if region != "frame" or not scene.insets]
    first = next(iter(runs.values()))
    rows = [[scene.name, "SPP", *(region.replace("-", " ") for region in shown), "rays per sample"]]
    for label, run in runs.items():
        pairs = [(run.errors[region]["mape"][-1], first.errors[region]["mape"][-1]) for region in shown]
        rays = run.rays[-1] / (run.spp * scene.film.width * scene.film.height)
        rows.append([label, str(run.spp), *(f"{value:.4f} ({value / base:.3f})" for value, base in pairs), f"{rays:.2f}"])
    own = [comparison.reference.own_error(region) for region in shown]
    cells = ["" if value is None else f"{value:.4f}" for value in own]
    return markdown([*rows, ["reference's own error", str(comparison.reference.spp), *cells, ""]])


def write_table(tables: Sequence[str], path: Path) -> None:
    """Markdown tables beside the JSON file `path`."""
    write_text(path.with_suffix(".md"), "\n\n".join(tables) + "\n")


def write_json(scenes: Mapping[str, Mapping], path: Path) -> None:
    """Numbers by scene, and the command."""
    write_text(path, json.dumps({"command": " ".join(sys.argv), "scenes": scenes}, indent=1) + "\n")
