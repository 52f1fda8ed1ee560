"""How much guiding gains: errors of every mode on the built-in scenes against long references.

    python scripts/evaluate.py --references references/long --out out/evaluation
    python scripts/evaluate.py daylight --inject 20 --inject-at 9 --references references/long --out out/injected

A reference is the mean of two independent halves. Their difference, as MAPE relative to the
mean, is about twice the error that the reference has left. It is compared with a uniform
render of other seeds too: z is the difference of the mean luminances over its standard
error, which comes from the variances that both films estimate. Test renders have seeds
that no reference uses.

`--inject` adds Gaussians that fit nothing: spread over the frame, behind the focal plane,
their projected σ 5 % of the aperture's radius. A mode that still fits the field replaces
them after one step; where `lis-o` has frozen the field (from step 8 on) they stay, and get
polynomials like any other.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch
from experiment import experiment_parser, load_scenes
from torch import Tensor

from bokehguide.cli.arguments import natural, positive
from bokehguide.cli.scripts import run
from bokehguide.evaluation import LongRender, accumulate, between_halves, errors, markdown, progress, regions, warn_of_bad_samples
from bokehguide.evaluation.long_renders import whole_step
from bokehguide.evaluation.references import CHUNK, rendered_halves
from bokehguide.evaluation.regions import mean_ratio
from bokehguide.image import check_writable, replacing, tone_map, write_png
from bokehguide.models.disc_distribution import balls
from bokehguide.render.vector import luminance
from bokehguide.scene import Scene
from bokehguide.train import LENS_MODES, MODES, RenderLoop, RenderSettings
from bokehguide.train.guide import FITS, LensGuide
from bokehguide.train.spot_guide import SpotGuide

UNIFORM_SEED, TEST_SEED = 3_000_000, 0
"""Seeds of the uniform check (one a chunk from there on) and of the test renders."""
REGIONS = ("frame", "insets")


def main() -> int:
    args = parse()
    scenes = load_scenes(args)
    check_writable(args.out / "results.json")
    deadline = time.monotonic() + args.time_limit
    results = {}
    for scene in scenes:
        first, second, uniform = long_renders(scene, args, deadline)
        wanted = (args.reference_spp // 2, args.reference_spp // 2, args.uniform_spp)
        if any(render.spp < spp for render, spp in zip((first, second, uniform), wanted)) or time.monotonic() > deadline:
            print(f"{scene.name}: time is up at {first.spp} + {second.spp} of {args.reference_spp} SPP of the reference")
            print(f"and {uniform.spp} of {args.uniform_spp} SPP of uniform sampling; the same command goes on\n")
            continue
        reference = LongRender(
            (first.radiance + second.radiance) / 2, (first.variance + second.variance) / 4, first.spp + second.spp
        )
        facts = judge_reference(scene, first, second, reference, uniform)
        results[scene.name] = {"reference": facts, "modes": judge_modes(scene, reference.radiance, args)}
        with replacing(args.out / "results.json") as temporary:
            settings = {name: str(value) for name, value in vars(args).items()}
            temporary.write_text(json.dumps({"settings": settings, "scenes": results}, indent=2) + "\n")
    if results:
        print("\n\n".join(tables(results, args)))
    return 0 if len(results) == len(scenes) else 1


def parse() -> argparse.Namespace:
    parser = experiment_parser(__doc__, "640x360", ",".join(LENS_MODES))
    add = parser.add_argument
    add("--spp", type=numbers, default=[64, 256], metavar="N,N", help="read the errors at these SPP, default 64,256")
    add("--references", type=Path, required=True, metavar="DIR", help="where the references are kept")
    add("--reference-spp", type=positive, default=4096, metavar="N", help="of both halves together, default 4096")
    add("--reference-mode", choices=MODES, default="lis-o")
    add("--uniform-spp", type=positive, default=1024, metavar="N", help="of the check by uniform sampling, default 1024")
    add("--inject", type=natural, default=0, metavar="N", help="Gaussians to add to the field by hand")
    add("--inject-at", type=natural, default=0, metavar="STEP", help="after this step, default 0: before the first")
    add("--out", type=Path, required=True, metavar="DIR", help="results.json and a folder of pictures for each scene")
    args = parser.parse_args()
    # Everything is told relative to uniform sampling.
    args.modes = ["uniform", *(mode for mode in args.modes if mode != "uniform")]
    return args


def numbers(text: str) -> list[int]:
    return sorted({positive(part) for part in text.split(",")})


def long_renders(scene: Scene, args: argparse.Namespace, deadline: float) -> list[LongRender]:
    """The two halves of the reference and the uniform render, as far as time allows."""
    half = RenderSettings(args.reference_mode, args.reference_spp // 2, threads=args.threads)
    uniform = RenderSettings("uniform", args.uniform_spp, UNIFORM_SEED, threads=args.threads)
    path = args.references / f"{scene.name}-{scene.film.width}x{scene.film.height}-uniform.exr"
    halves = rendered_halves(args.references, scene, half, deadline)
    return [*halves, accumulate(path, scene, uniform, CHUNK, deadline)]


def judge_reference(
    scene: Scene, first: LongRender, second: LongRender, reference: LongRender, uniform: LongRender
) -> dict[str, object]:
    """How far the halves are apart, and whether uniform sampling agrees with them."""
    facts: dict[str, object] = {"spp": reference.spp, "uniform_spp": uniform.spp}
    for region, mask in masks(scene).items():
        apart = between_halves(first.radiance[mask][None], reference.radiance[mask][None])
        light, other = (luminance(render.radiance[mask].T) for render in (reference, uniform))
        against = mean_ratio(light, other, reference.variance[mask] + uniform.variance[mask])
        facts[region] = {
            "halves_mape": apart["mape"],
            "halves_relmse": apart["relmse"],
            "over_uniform": against.ratio,
            "standard_error": against.standard_error,
            "z": against.z,
        }
    return facts


def judge_modes(scene: Scene, reference: Tensor, args: argparse.Namespace) -> dict[str, dict]:
    """Errors by mode, SPP and region; writes the pictures."""
    folder = args.out / scene.name
    check_writable(folder / "reference.png")
    write_png(folder / "reference.png", tone_map(reference))
    images = {mode: render_mode(scene, mode, args) for mode in args.modes}
    results = {}
    for mode, by_spp in images.items():
        results[mode] = {
            spp: {region: errors(image, reference, mask) for region, mask in masks(scene).items()} for spp, image in by_spp.items()
        }
        for spp, image in by_spp.items():
            write_png(folder / f"{mode}-{spp}.png", tone_map(image))
    for spp in args.spp:
        row = [by_spp[spp] for by_spp in images.values()] + [reference]
        for number, inset in enumerate(scene.insets, start=1):
            rows, columns = inset.pixels(scene.film.width, scene.film.height)
            crops = torch.cat([image[rows, columns] for image in row], dim=1)
            write_png(folder / f"inset-{number}-{spp}.png", tone_map(crops))
    return results


def render_mode(scene: Scene, mode: str, args: argparse.Namespace) -> dict[int, Tensor]:
    """Radiance `[H, W, 3]` of one render at each of the SPP."""
    loop = RenderLoop(scene, RenderSettings(mode, max(args.spp), TEST_SEED, threads=args.threads))
    images = {}
    title = f"{scene.name} {mode}"
    with progress(title, max(args.spp)) as bar:
        for step in range(max(args.spp)):
            if args.inject and step == args.inject_at and loop.guide is not None:
                inject(loop, args.inject)
            whole_step(loop)
            bar.update()
            if step + 1 in args.spp:
                images[step + 1] = loop.film.radiance().cpu()
    warn_of_bad_samples(loop.film, title)
    return images


def inject(loop: RenderLoop, count: int) -> None:
    """Add Gaussians at random raster positions, two to five focus distances away."""
    camera, field = loop.camera, loop.guide.field
    lens = camera.lens
    random = torch.Generator().manual_seed(0)
    x, y, far = torch.rand(3, count, generator=random)
    slopes = camera.slopes(torch.stack((x * camera.width, y * camera.height)))
    depth = (2.0 + 3.0 * far) * lens.focus_distance
    mean = torch.cat((slopes * depth, depth[None]))
    # Seen through the lens at |k|σ, k = d_F / (d_F - Z).
    sigma = 0.05 * lens.radius * (depth - lens.focus_distance) / lens.focus_distance
    added = (mean, 2.0 * sigma, sigma, sigma.square())
    kept = (field.mean, field.radius, field.sigma, field.energy)
    field.assign(*(torch.cat((old.cpu(), new), dim=-1) for old, new in zip(kept, added)))
    if isinstance(loop.guide, SpotGuide):
        loop.guide.outlines = torch.cat((loop.guide.outlines.cpu(), balls(sigma)), dim=1).to(field.mean.device)
    if isinstance(loop.guide, LensGuide) and loop.guide.learns_offsets and loop.step_number >= FITS:
        loop.guide.freeze()
    else:
        loop.guide.set_candidates()


def masks(scene: Scene) -> dict[str, Tensor]:
    """The pixels of each of REGIONS, bool `[H, W]`."""
    found = regions(scene)
    return {region: found[region] for region in REGIONS}


def tables(results: dict[str, dict], args: argparse.Namespace) -> list[str]:
    """Markdown: one table of the references, then for each SPP one of the frame and one of the insets."""
    rows = [["scene", "SPP", "uniform SPP", *(f"{region}: {what}" for region in REGIONS for what in ("halves", "/ uniform", "z"))]]
    for name, result in results.items():
        facts = result["reference"]
        row = [name, str(facts["spp"]), str(facts["uniform_spp"])]
        for region in (facts[region] for region in REGIONS):
            ratio = f"{region['over_uniform']:.5f} ± {region['standard_error']:.5f}"
            row += [f"{region['halves_mape']:.5f}", ratio, f"{region['z']:+.2f}"]
        rows.append(row)
    made = ["References: MAPE between the halves, mean luminance over that of uniform sampling\n\n" + markdown(rows)]
    for spp in args.spp:
        for region in REGIONS:
            rows = [["scene", *args.modes]]
            for name, result in results.items():
                mapes = [result["modes"][mode][spp][region]["mape"] for mode in args.modes]
                cells = [f"{value:.5f} ({value / mapes[0]:.3f})" for value in mapes[1:]]
                rows.append([name, f"{mapes[0]:.5f}", *cells])
            made.append(f"MAPE over the {region} at {spp} SPP (ratio to uniform)\n\n{markdown(rows)}")
    return made


if __name__ == "__main__":
    run(main, "the same command goes on with the references")
