"""A complete render in Python, from the scene to the EXR: the loop of `bokehguide render`.

One SPP is one training step: sample the lens, trace paths, add the samples to the film, train the guide on the samples.

    python scripts/render.py fairy-lights --mode guided --spp 64 --size 320x180
    tensorboard --logdir logs
"""

import argparse

from tqdm import trange

from bokehguide.cli.parser import Parser, exr, natural, positive, size
from bokehguide.cli.scripts import run
from bokehguide.image import Display, check_writable, write_exr, write_png
from bokehguide.metrics import mape, read_reference, relmse
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import MODES, RenderLogger, RenderLoop, RenderSettings, describe_render


def main() -> None:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a built-in scene, a .toml scene file or a model")
    parser.add_argument("--mode", choices=MODES, default="guided")
    parser.add_argument("--spp", type=positive, default=64)
    parser.add_argument("--size", type=size, default="640x360")
    parser.add_argument("--seed", type=natural, default=0)
    parser.add_argument("--reference", help="an EXR of the same size to measure the error against")
    parser.add_argument("--logdir", default="logs")
    parser.add_argument("--out", type=exr, default="render.exr")
    args = parser.parse_args()

    # The scene is plain data.
    width, height = args.size
    scene = load_scene(args.scene, Overrides(width=width, height=height))
    check_writable(args.out)
    reference = read_reference(args.reference, width, height) if args.reference else None

    # The loop owns the model with its optimiser (Gaussians, blend weights, polynomials), the film and the worker threads.
    settings = RenderSettings(mode=args.mode, spp=args.spp, seed=args.seed)
    with RenderLoop(scene, settings) as loop:
        logger = RenderLogger(args.logdir, scene, settings)
        progress = trange(settings.spp, unit="SPP")
        for _ in progress:
            stats = loop.step()  # sample, trace, accumulate, train
            radiance = loop.film.radiance()  # the mean so far, [H, W, 3]
            errors = {}
            if reference is not None:
                errors = {"mape": mape(radiance, reference), "relmse": relmse(radiance, reference)}
            logger.log(loop, stats, errors, loop.film)
            progress.set_postfix(kl=stats.kl, gaussians=stats.gaussians, **errors)
        logger.finish(loop, settings.spp, loop.film)

    write_exr(args.out, loop.film.layers(), describe_render(scene, settings, settings.spp))
    write_png(args.out.with_suffix(".png"), Display().show(loop.film.radiance()))
    print(f"wrote {args.out}; curves: tensorboard --logdir {args.logdir}")


if __name__ == "__main__":
    run(main)
