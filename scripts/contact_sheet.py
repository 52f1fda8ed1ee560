"""A contact sheet: every model under every environment map, rendered with the default camera.

    python scripts/contact_sheet.py MODEL_OR_FOLDER... --maps MAP... --out sheet.png

A row is a model and a column is a map. A model that the command refuses has its message in place of a picture.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

from PIL import Image, ImageDraw

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
LABEL = 16
"""Height of a label in pixels."""


def main() -> None:
    options = parse()
    models = [model for path in options.models for model in find_models(path)]
    width, height = map(int, options.size.split("x"))
    sheet = Image.new("RGB", (len(options.maps) * width, len(models) * (height + LABEL)), (24, 24, 24))
    draw = ImageDraw.Draw(sheet)
    for row, model in enumerate(models):
        for column, environment in enumerate(options.maps):
            place = (column * width, row * (height + LABEL))
            draw.text((place[0] + 4, place[1] + 2), f"{model.stem} · {environment.stem}"[: width // 6], fill=(220, 220, 220))
            sheet.paste(picture(model, environment, options, (width, height)), (place[0], place[1] + LABEL))
    sheet.save(options.out)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path, help="models, or folders of models")
    parser.add_argument("--maps", nargs="+", type=Path, required=True, help="environment maps")
    parser.add_argument("--out", type=Path, required=True, help="the sheet, a PNG")
    parser.add_argument("--size", default="240x135", help="pixels of a picture (default: 240x135)")
    parser.add_argument("--spp", default="16", help="samples per pixel (default: 16)")
    return parser.parse_args()


def find_models(path: Path) -> list[Path]:
    """The model at `path`, or the models in this folder and in its direct subfolders."""
    if path.is_file():
        return [path]
    return sorted(file for file in (*path.glob("*"), *path.glob("*/*")) if file.suffix.lower() in SUFFIXES)


def picture(model: Path, environment: Path, options: argparse.Namespace, size: tuple[int, int]) -> Image.Image:
    """The render of one model under one map, or the error message."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "picture.exr"
        command = [sys.executable, "-m", "bokehguide", "render", str(model), "--environment", str(environment)]
        command += ["--size", options.size, "--spp", options.spp, "--out", str(out), "--checkpoint-every", "0"]
        finished = subprocess.run(command, capture_output=True, text=True)
        if finished.returncode == 0:
            return Image.open(out.with_suffix(".png")).convert("RGB")
    message = Image.new("RGB", size, (60, 30, 30))
    words = finished.stderr.replace(str(model.parent) + "/", "").strip().splitlines()
    ImageDraw.Draw(message).text((6, 6), textwrap.fill(words[-1] if words else "failed", size[0] // 7), fill=(240, 220, 220))
    return message


if __name__ == "__main__":
    main()
