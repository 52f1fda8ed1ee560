"""Renders by the command line, and their pictures side by side, for `quickstart.py`, `hero.py` and `gallery.py`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

MODES = {"uniform": "uniform lens sampling", "guided": "guided lens sampling"}
"""The compared modes, and their names in pictures."""
GAP, BAR = 4, 26
"""Pixels between the pictures, and of the text above each."""


def render(*arguments: object, threads: int | None = None, folder: Path | None = None) -> None:
    """Run `bokehguide render` in a folder, without checkpoints. A failure ends this process with the exit code of the command."""
    command = [sys.executable, "-m", "bokehguide", "render", *map(str, arguments), "--checkpoint-every", "0"]
    command += ["--threads", str(threads)] if threads else []
    finished = subprocess.run(command, check=False, cwd=folder)
    if finished.returncode:
        sys.exit(finished.returncode)


def labelled(png: Path, text: str) -> Image.Image:
    """The picture under a line of text."""
    with Image.open(png) as image:
        canvas = Image.new("RGB", (image.width, image.height + BAR))
        canvas.paste(image, (0, BAR))
    ImageDraw.Draw(canvas).text((6, 5), text, fill="white", font=ImageFont.load_default(15))
    return canvas


def side_by_side(pictures: list[Image.Image]) -> Image.Image:
    """The pictures in a row, GAP pixels apart."""
    width = sum(picture.width for picture in pictures) + GAP * (len(pictures) - 1)
    row = Image.new("RGB", (width, max(picture.height for picture in pictures)))
    left = 0
    for picture in pictures:
        row.paste(picture, (left, 0))
        left += picture.width + GAP
    return row
