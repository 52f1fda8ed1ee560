"""Render the pictures of the README's gallery and of the tutorials.

    python scripts/gallery.py --threads 2
    python scripts/gallery.py chrome cutout

Each picture is one `bokehguide render` command; the README prints the command beside the picture.
A picture that exists is skipped, unless the command names the picture.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from pathlib import Path

import trimesh
from pictures import render
from PIL import Image

ROOT = Path(__file__).parent.parent
IMAGES, TUTORIAL = ROOT / "docs" / "images", ROOT / "docs" / "tutorials" / "your-own-model.md"
GALLERY = {
    name: f"{name} --size 480x270 --spp 96" for name in ("occluded", "chrome", "night-street", "glitter", "cutout", "daylight")
}
TUTORIALS = {
    "first-uniform": "fairy-lights --size 320x180 --spp 32 --mode uniform",
    "first-guided": "fairy-lights --size 320x180 --spp 32 --mode guided",
    "ring": "ring.toml --size 480x270 --spp 64",
}
PICTURES = GALLERY | TUTORIALS


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)} (default: all that are missing)")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of each render (default: one per core)")
    parser.add_argument("--out", type=Path, default=IMAGES, metavar="DIR", help="folder of the WebP files (default: docs/images)")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(PICTURES))
    if unknown:
        parser.error(f"unknown pictures: {', '.join(unknown)}")
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.names or PICTURES:
        picture = options.out.resolve() / f"{name}.webp"
        if options.names or not picture.exists():
            write_picture(PICTURES[name], picture, options.threads)
            print(f"wrote {picture} ({picture.stat().st_size / 1024:.0f} KiB)")
    return 0


def write_picture(arguments: str, picture: Path, threads: int | None) -> None:
    """Render in an empty folder and convert the PNG."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "ring.toml" in arguments:
            write_ring(folder)
        render(*arguments.split(), "--out", "picture.exr", threads=threads, folder=folder)
        with Image.open(folder / "picture.png") as image:
            image.save(picture, quality=88, method=6)


def write_ring(folder: Path) -> None:
    """The model and the scene file of the tutorial."""
    ring = trimesh.creation.torus(0.30, 0.09, major_sections=96, minor_sections=48)
    ring.export(folder / "ring.obj", include_normals=True)
    text = re.search(r'```toml title="ring.toml"\n(.*?)```', TUTORIAL.read_text(encoding="utf-8"), re.S)
    (folder / "ring.toml").write_text(text[1])


if __name__ == "__main__":
    sys.exit(main())
