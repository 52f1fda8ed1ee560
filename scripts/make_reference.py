"""Render a reference image in two independent halves, whose difference estimates its error.

    python scripts/make_reference.py fairy-lights --size 320x180 --spp 8192 --half \\
        --out references/fairy-lights-320x180.exr

Each half has half of the SPP and its own seed. It is rendered at twice the width and height with a quarter of its SPP, and
averaged over 2×2 pixels. With a box filter this is the same image; the larger frame resolves smaller highlights for the guide
and makes larger batches. If the relMSE between the halves is e, the relMSE of their mean is about e / 4.
"""

import argparse
import json

from torch import Tensor

from bokehguide.cli.parser import Parser, exr, natural, positive, size
from bokehguide.cli.scripts import run
from bokehguide.evaluation import between_halves, progress, render, warn_of_bad_samples
from bokehguide.image import check_writable, write_exr
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import MODES, RenderSettings


def main() -> None:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a built-in scene, a .toml scene file or a model")
    parser.add_argument("--size", type=size, default="320x180", metavar="WxH", help="default: 320x180")
    parser.add_argument(
        "--spp", type=positive, default=8192, metavar="N", help="SPP of both halves together, a multiple of 8 (default: 8192)"
    )
    parser.add_argument("--mode", choices=MODES, default="guided")
    parser.add_argument(
        "--seed",
        type=natural,
        default=1000,
        metavar="N",
        help="seed of the first half; the second half has the next seed (default: 1000)",
    )
    parser.add_argument("--half", action="store_true", help="store 16-bit floats")
    parser.add_argument("--out", type=exr, required=True, metavar="PATH.exr", help="output file")
    args = parser.parse_args()
    if args.spp % 8:
        parser.error(f"argument --spp: {args.spp} is not a multiple of 8: two halves of 2×2 renders")

    width, height = args.size
    scene = load_scene(args.scene, Overrides(width=2 * width, height=2 * height))
    check_writable(args.out)
    first, second = (render_half(scene, args.mode, args.spp // 8, seed) for seed in (args.seed, args.seed + 1))
    mean = (first + second) / 2
    difference = between_halves(first, mean)
    print("between the halves: " + ", ".join(f"{name} {value:.5f}" for name, value in difference.items()))
    facts = {
        "scene": scene.name,
        "mode": args.mode,
        "spp": args.spp,
        "seed": args.seed,
        "between_halves": json.dumps(difference),
    }
    write_exr(args.out, {"beauty": mean.numpy()}, facts, half=args.half)
    print(f"wrote {args.out}")


def render_half(scene: Scene, mode: str, spp: int, seed: int) -> Tensor:
    """Radiance `[H / 2, W / 2, 3]` of `spp` samples per pixel of the scene."""
    title = f"{scene.name} {mode}, seed {seed}"
    with progress(title, spp) as bar:
        film = render(scene, RenderSettings(mode=mode, spp=spp, seed=seed), bar)
    warn_of_bad_samples(film, title)
    return film.radiance().unflatten(0, (-1, 2)).unflatten(2, (-1, 2)).mean((1, 3))


if __name__ == "__main__":
    run(main)
