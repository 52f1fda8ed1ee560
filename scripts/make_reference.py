"""Make a reference image in two independent halves, whose difference says how good it is.

    python scripts/make_reference.py fairy-lights --size 320x180 --spp 4096 --half \\
        --out references/fairy-lights-320x180.exr

Each half gets half of the SPP and a seed of its own. Where the halves differ by a relMSE of e,
their mean differs from the truth by about e / 4.
"""

import argparse
import json
import sys

import torch
from torch import Tensor
from tqdm import trange

from bokehguide.errors import BokehguideError
from bokehguide.image import write_exr
from bokehguide.image.files import check_writable
from bokehguide.metrics import mape, relmse
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import MODES, RenderLoop, RenderSettings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a built-in scene, a .toml scene file or a model")
    parser.add_argument("--size", default="320x180", help="WxH, default 320x180")
    parser.add_argument("--spp", type=int, default=4096, help="of both halves together, default 4096")
    parser.add_argument("--mode", choices=MODES, default="lis-o")
    parser.add_argument("--seed", type=int, default=1000, help="of the first half; the second takes the next one")
    parser.add_argument("--half", action="store_true", help="store 16-bit floats")
    parser.add_argument("--out", required=True, help="the EXR to write")
    args = parser.parse_args()

    width, height = map(int, args.size.split("x"))
    scene = load_scene(args.scene, Overrides(width=width, height=height))
    check_writable(args.out)
    first, second = (render(scene, args.mode, args.spp // 2, seed) for seed in (args.seed, args.seed + 1))
    mean = (first + second) / 2
    # Relative to their mean, from which either half is half their difference away.
    difference = {"mape": 2 * mape(first, mean), "relmse": 4 * relmse(first, mean)}
    print("between the halves: " + ", ".join(f"{name} {value:.5f}" for name, value in difference.items()))
    facts = {
        "scene": scene.name,
        "mode": args.mode,
        "spp": 2 * (args.spp // 2),
        "seed": args.seed,
        "between_halves": json.dumps(difference),
    }
    write_exr(args.out, {"beauty": mean.numpy()}, facts, half=args.half)
    print(f"wrote {args.out}")


def render(scene: Scene, mode: str, spp: int, seed: int) -> Tensor:
    """Radiance `[H, W, 3]` of `spp` samples a pixel."""
    loop = RenderLoop(scene, RenderSettings(mode=mode, spp=spp, seed=seed))
    for _ in trange(spp, desc=f"seed {seed}", unit="SPP", mininterval=1.0):
        loop.step()
    return loop.film.radiance()


if __name__ == "__main__":
    try:
        main()
    except BokehguideError as error:
        sys.exit(f"make_reference: error: {error}")
