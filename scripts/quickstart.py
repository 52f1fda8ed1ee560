"""`make render`: fairy-lights with uniform and with guided lens sampling, side by side.

python scripts/quickstart.py out
"""

import os
import subprocess
import sys
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont

from bokehguide.image import read_rgb, to_8_bit, tone_map
from bokehguide.metrics import mape

SCENE, SIZE, SPP = "fairy-lights", "320x180", 64
MODES = {"uniform": "uniform lens sampling", "guided": "guided lens sampling"}
REFERENCE = Path(__file__).parent.parent / "references" / f"{SCENE}-{SIZE}.exr"


def main(out: Path) -> None:
    images = {mode: out / f"{SCENE}-{mode}.exr" for mode in MODES}
    for mode, image in images.items():
        render(mode, image, out / "logs")

    reference = torch.from_numpy(read_rgb(REFERENCE))
    errors = {mode: mape(torch.from_numpy(read_rgb(image)), reference) for mode, image in images.items()}
    pair = out / f"{SCENE}-side-by-side.png"
    side_by_side([labelled(images[mode], f"{MODES[mode]}, MAPE {errors[mode]:.3f}") for mode in MODES]).save(pair)

    print(f"\n{'':12}{'MAPE':<8}EXR (with a PNG of the same name)")
    for mode, image in images.items():
        print(f"{mode:<12}{errors[mode]:<8.4f}{image}")
    print(f"\nside by side  {pair}\nTensorBoard   {out / 'logs'}")
    tensorboard = os.path.relpath(Path(sys.executable).parent / "tensorboard")
    print(f"open it with  {tensorboard} --logdir {out / 'logs' / SCENE}")


def render(mode: str, image: Path, logs: Path) -> None:
    """Run the command line."""
    command = [sys.executable, "-m", "bokehguide", "render", SCENE, "--mode", mode, "--size", SIZE, "--spp", str(SPP)]
    command += ["--out", str(image), "--logdir", str(logs), "--reference", str(REFERENCE), "--checkpoint-every", "0"]
    finished = subprocess.run(command, check=False)
    if finished.returncode:
        sys.exit(finished.returncode)


def labelled(image: Path, text: str) -> Image.Image:
    """The tone-mapped image below a line of text."""
    display = to_8_bit(tone_map(torch.from_numpy(read_rgb(image))))
    height, width = display.shape[:2]
    canvas = Image.new("RGB", (width, height + 24))
    canvas.paste(Image.fromarray(display), (0, 24))
    ImageDraw.Draw(canvas).text((6, 4), text, fill="white", font=ImageFont.load_default(14))
    return canvas


def side_by_side(images: list[Image.Image]) -> Image.Image:
    """The images in a row, 4 pixels apart."""
    width = sum(image.width for image in images) + 4 * (len(images) - 1)
    row = Image.new("RGB", (width, max(image.height for image in images)))
    left = 0
    for image in images:
        row.paste(image, (left, 0))
        left += image.width + 4
    return row


if __name__ == "__main__":
    main(Path(sys.argv[1]))
