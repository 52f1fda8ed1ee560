"""`make render`: fairy-lights with uniform and with guided lens sampling, side by side.

python scripts/quickstart.py out
"""

import os
import sys
from pathlib import Path

import torch
from pictures import MODES, labelled, render, side_by_side

from bokehguide.image import read_rgb
from bokehguide.metrics import mape

SCENE, SIZE, SPP = "fairy-lights", "320x180", 64
REFERENCE = Path(__file__).parent.parent / "references" / f"{SCENE}-{SIZE}.exr"


def main(out: Path) -> None:
    images = {mode: out / f"{SCENE}-{mode}.exr" for mode in MODES}
    for mode, image in images.items():
        facts = ("--out", image, "--logdir", out / "logs", "--reference", REFERENCE)
        render(SCENE, "--mode", mode, "--size", SIZE, "--spp", SPP, *facts)

    reference = torch.from_numpy(read_rgb(REFERENCE))
    errors = {mode: mape(torch.from_numpy(read_rgb(image)), reference) for mode, image in images.items()}
    pair = out / f"{SCENE}-side-by-side.png"
    texts = {mode: f"{MODES[mode]}, MAPE {errors[mode]:.3f}" for mode in MODES}
    side_by_side([labelled(images[mode].with_suffix(".png"), text) for mode, text in texts.items()]).save(pair)

    print(f"\n{'':12}{'MAPE':<8}EXR (with a PNG of the same name)")
    for mode, image in images.items():
        print(f"{mode:<12}{errors[mode]:<8.4f}{image}")
    print(f"\nside by side  {pair}\nTensorBoard   {out / 'logs'}")
    tensorboard = os.path.relpath(Path(sys.executable).parent / "tensorboard")
    print(f"open it with  {tensorboard} --logdir {out / 'logs' / SCENE}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
