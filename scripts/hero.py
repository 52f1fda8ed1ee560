"""Render the README's first picture: uniform beside guided lens sampling at equal time.

    python scripts/hero.py --threads 2

Guided sampling renders `--spp` samples per pixel. Uniform sampling then renders for the same seconds, and both pictures
are placed side by side. Run the script on an idle machine: other jobs change the number of uniform samples.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

OUT = Path(__file__).parent.parent / "docs" / "images" / "hero.webp"
MODES = {"uniform": "uniform lens sampling", "guided": "guided lens sampling"}
MANY = 1_000_000
"""SPP of the uniform render, which its time limit ends."""
GAP, BAR = 4, 26
"""Pixels between the pictures, and of the text above each."""


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
        guided = render("guided", folder, options, "--spp", str(options.spp))
        uniform = render("uniform", folder, options, "--spp", str(MANY), "--time-limit", f"{guided['seconds']:.3f}")
        facts = {"uniform": uniform, "guided": guided}
        pictures = [labelled(folder / f"{mode}.png", caption(mode, facts[mode])) for mode in MODES]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    side_by_side(pictures).save(options.out, quality=88)
    for mode in MODES:
        print(f"{mode:<8} {facts[mode]['spp']:>5} SPP  {facts[mode]['seconds']:8.1f} s")
    print(f"wrote {options.out} ({options.out.stat().st_size / 1024:.0f} KiB)")
    return 0


def render(mode: str, folder: Path, options: argparse.Namespace, *more: str) -> dict:
    """Run `bokehguide render`; returns the facts of its JSON."""
    facts = folder / f"{mode}.json"
    command = [sys.executable, "-m", "bokehguide", "render", options.scene, "--mode", mode, "--size", options.size]
    command += ["--out", str(folder / f"{mode}.exr"), "--json", str(facts), "--checkpoint-every", "0", *more]
    command += ["--threads", str(options.threads)] if options.threads else []
    finished = subprocess.run(command, check=False)
    if finished.returncode:
        sys.exit(finished.returncode)
    return json.loads(facts.read_text())


def caption(mode: str, facts: dict) -> str:
    return f"{MODES[mode]}: {facts['spp']} SPP, {facts['seconds']:.0f} s"


def labelled(png: Path, text: str) -> Image.Image:
    """The picture under a line of text."""
    with Image.open(png) as image:
        canvas = Image.new("RGB", (image.width, image.height + BAR))
        canvas.paste(image, (0, BAR))
    ImageDraw.Draw(canvas).text((6, 5), text, fill="white", font=ImageFont.load_default(15))
    return canvas


def side_by_side(pictures: list[Image.Image]) -> Image.Image:
    width = sum(picture.width for picture in pictures) + GAP * (len(pictures) - 1)
    row = Image.new("RGB", (width, max(picture.height for picture in pictures)))
    left = 0
    for picture in pictures:
        row.paste(picture, (left, 0))
        left += picture.width + GAP
    return row


if __name__ == "__main__":
    sys.exit(main())
