"""Render the README's first picture: uniform beside guided lens sampling at equal time.

    python scripts/hero.py --threads 2

Guided sampling renders `--spp` samples per pixel. Uniform sampling then renders for the same seconds, and both pictures
are placed side by side. Run the script on an idle machine: other jobs change the number of uniform samples.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from pictures import MODES, labelled, render, side_by_side

OUT = Path(__file__).parent.parent / "docs" / "images" / "hero.webp"
MANY = 1_000_000
"""SPP of the uniform render, which its time limit ends."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="fairy-lights", help="default: fairy-lights")
    parser.add_argument("--size", default="640x360", metavar="WxH", help="pixels of each picture (default: 640x360)")
    parser.add_argument("--spp", type=int, default=64, metavar="N", help="samples per pixel of the guided render (default: 64)")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of each render (default: one per core)")
    parser.add_argument("--out", type=Path, default=OUT, metavar="PATH", help="WebP or PNG (default: docs/images/hero.webp)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        guided = rendered("guided", folder, options, "--spp", options.spp)
        uniform = rendered("uniform", folder, options, "--spp", MANY, "--time-limit", f"{guided['seconds']:.3f}")
        facts = {"uniform": uniform, "guided": guided}
        pictures = [labelled(folder / f"{mode}.png", caption(mode, facts[mode])) for mode in MODES]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    side_by_side(pictures).save(options.out, quality=88)
    for mode in MODES:
        print(f"{mode:<8} {facts[mode]['spp']:>5} SPP  {facts[mode]['seconds']:8.1f} s")
    print(f"wrote {options.out} ({options.out.stat().st_size / 1024:.0f} KiB)")
    return 0


def rendered(mode: str, folder: Path, options: argparse.Namespace, *more: object) -> dict:
    """Render a mode; returns the facts of its JSON."""
    facts = folder / f"{mode}.json"
    files = ("--out", folder / f"{mode}.exr", "--json", facts)
    render(options.scene, "--mode", mode, "--size", options.size, *files, *more, threads=options.threads)
    return json.loads(facts.read_text())


def caption(mode: str, facts: dict) -> str:
    return f"{MODES[mode]}: {facts['spp']} SPP, {facts['seconds']:.0f} s"


if __name__ == "__main__":
    sys.exit(main())
