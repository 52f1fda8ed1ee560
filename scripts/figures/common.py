"""What the scripts of the figures share: their options, how they compare, and the JSON they end in.

The renders go into a folder for each scene under `--out`, where all figures find them: what one
has rendered, the next does not render again. References are kept apart, in `--cache`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from bokehguide.cli.arguments import Parser, positive, size, threads
from bokehguide.errors import BokehguideError
from bokehguide.evaluation import Comparison, compare, made_reference, summary
from bokehguide.evaluation.comparison import SEED
from bokehguide.image import check_writable, replacing
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import RenderSettings

REFERENCE_SHARE = 32
"""SPP of a reference for one of a mode's."""
PAPER_WIDTH, PAPER_RADIUS = 1920, 50
"""The paper's pictures, and how far Area ReSTIR looks for neighbours in them; in smaller ones, over the same part."""


def figure_options(doc: str, scenes: Sequence[str]) -> argparse.Namespace:
    """The command line of a figure that shows `scenes` if nothing else is asked for; makes its folder."""
    parser = Parser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
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


def compared(modes: Sequence[str], options: argparse.Namespace) -> list[Comparison]:
    """The modes on each scene against a reference, rendered as far as they are not yet there."""
    return [_compared(name, modes, options) for name in options.scenes]


def _compared(name: str, modes: Sequence[str], options: argparse.Namespace) -> Comparison:
    width, height = options.size
    scene = load_scene(name, Overrides(width=width, height=height))
    radius = max(1.0, PAPER_RADIUS * width / PAPER_WIDTH)
    common = {"spp": options.spp, "seed": SEED, "threads": options.threads, "reuse_radius": radius}
    every = [RenderSettings(mode, **common) for mode in modes]
    folder = options.out / scene.name
    whole = RenderSettings(spp=REFERENCE_SHARE * options.spp, threads=options.threads)
    reference = made_reference(scene, whole, folder / "reference.exr", options.cache)
    return compare(scene, every, reference, folder)


def write_numbers(comparisons: Sequence[Comparison], path: Path) -> None:
    """The numbers behind a figure, as JSON."""
    scenes = {
        comparison.scene.name: {"reference": comparison.reference.facts(), **summary(comparison)}
        for comparison in comparisons
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps({"command": " ".join(sys.argv), "scenes": scenes}, indent=1) + "\n")


def run(main: Callable[[], None]) -> None:
    """Call a script's `main`; a mistake of the user becomes one line and the exit code 2."""
    try:
        main()
    except BokehguideError as error:
        print(f"{Path(sys.argv[0]).stem}: error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(f"{Path(sys.argv[0]).stem}: interrupted; what is finished is kept, and the same command goes on")
