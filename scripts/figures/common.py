"""What the scripts of the figures share: their options, how they compare, and the JSON they end in.

The renders go into a folder for each scene under `--out`, where all figures find them: what one
has rendered, the next does not render again. References are kept apart, in `--cache`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from bokehguide.cli.arguments import Parser, positive, size, threads
from bokehguide.evaluation import Comparison, compare, made_reference, summary
from bokehguide.evaluation.comparison import SEED
from bokehguide.image import check_writable, replacing
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import RenderSettings

REFERENCE_SHARE = 16
"""SPP of a reference for one of a mode's, as `compare` has it."""
PAPER_WIDTH, PAPER_RADIUS = 1920, 50
"""The paper's pictures, and how far Area ReSTIR looks for neighbours in them; in smaller ones, over the same part."""


@dataclass(frozen=True)
class Variant:
    """A mode that is rendered in another way than the others, and kept in a folder of its own.

    change: makes the context in which it is rendered, which holds what is changed of the method.
    spp_divisor: of the SPP, for a mode that costs many times the others.
    """

    label: str
    mode: str
    folder: str
    change: Callable[[], AbstractContextManager] = nullcontext
    spp_divisor: int = 1


def figure_options(
    doc: str, scenes: Sequence[str], add_more: Callable[[Parser], None] = lambda parser: None
) -> argparse.Namespace:
    """The command line of a figure that shows `scenes` if nothing else is asked for; makes its folder.

    add_more: adds the options that no other figure has.
    """
    parser = Parser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_more(parser)
    add = parser.add_argument
    add("scenes", nargs="*", default=list(scenes), metavar="SCENE", help=f"default: {', '.join(scenes)}")
    add("--size", type=size, default="320x180", metavar="WxH", help="default 320x180")
    add("--spp", type=positive, default=64, metavar="N", help="of each mode, default 64")
    add("--threads", type=threads, metavar="N", help="default: one per core")
    add("--cache", type=Path, metavar="DIR", help="where references are kept, default the user's cache folder")
    add("--out", type=Path, default=Path("out/figures"), metavar="DIR", help="default out/figures")
    options = parser.parse_args()
    check_writable(options.out / "figure")
    return options


def compared(shown: Sequence[str | Variant], options: argparse.Namespace) -> list[Comparison]:
    """Modes and variants of them on each scene against a reference, rendered as far as they are not yet there."""
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
            changed = replace(modes[0], mode=variant.mode, spp=max(1, options.spp // variant.spp_divisor))
            with variant.change():
                one = compare(scene, [changed], reference, folder / variant.folder)
            runs[variant.label], images[variant.label] = one.runs[variant.mode], one.images[variant.mode]
    labels = [one.label if isinstance(one, Variant) else one for one in shown]
    pick = ({label: found[label] for label in labels} for found in (runs, images))
    return Comparison(scene, modes[0], reference, *pick, plain.over_uniform)


def sized(name: str, options: argparse.Namespace) -> Scene:
    """A scene at the figure's size."""
    width, height = options.size
    return load_scene(name, Overrides(width=width, height=height))


def settings(mode: str, options: argparse.Namespace) -> RenderSettings:
    """Those of a mode in all figures."""
    radius = max(1.0, PAPER_RADIUS * options.size[0] / PAPER_WIDTH)
    return RenderSettings(mode, options.spp, SEED, threads=options.threads, reuse_radius=radius)


def relabelled(comparison: Comparison, labels: Mapping[str, str]) -> Comparison:
    """The comparison with other names over its columns."""
    renamed = [{labels.get(name, name): found for name, found in one.items()} for one in (comparison.runs, comparison.images)]
    return replace(comparison, runs=renamed[0], images=renamed[1])


def write_numbers(comparisons: Sequence[Comparison], path: Path, more: Mapping[str, Mapping] = {}) -> None:
    """The numbers behind a figure, as JSON. more: by scene, what this figure shows besides."""
    scenes = {
        comparison.scene.name: {
            "reference": comparison.reference.facts(),
            **summary(comparison),
            **more.get(comparison.scene.name, {}),
        }
        for comparison in comparisons
    }
    write_json(scenes, path)


def write_json(scenes: Mapping[str, Mapping], path: Path) -> None:
    """What was measured by scene, and the command."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps({"command": " ".join(sys.argv), "scenes": scenes}, indent=1) + "\n")
