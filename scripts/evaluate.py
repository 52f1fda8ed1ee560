"""Errors of every mode on the built-in scenes against long references.

    python scripts/evaluate.py --out out/evaluation
    python scripts/evaluate.py daylight --size 320x180 --spp 64 --reference-spp 1024

A reference is the mean of two independent halves. Their MAPE relative to the mean is about twice the reference's own
error. The reference is also compared with a uniform render of other seeds: z is the difference of the mean luminances
over its standard error, from the variances that both films estimate. Test renders have seeds that no reference uses.
Writes evaluation.md, evaluation.json and a folder of pictures for each scene into `--out`.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch
from experiments.options import experiment_parser, load_scenes, numbers
from torch import Tensor

from bokehguide.cli.parser import positive
from bokehguide.cli.report import write_json
from bokehguide.cli.scripts import run
from bokehguide.evaluation import LongRender, accumulate, between_halves, errors, markdown, progress, regions, warn_of_bad_samples
from bokehguide.evaluation.long_renders import whole_step
from bokehguide.evaluation.references import CHUNK, half_files, rendered_halves
from bokehguide.evaluation.regions import mean_ratio
from bokehguide.image import check_writable, tone_map, write_png, write_text
from bokehguide.render.vector import luminance
from bokehguide.scene import Scene
from bokehguide.train import LENS_MODES, RenderLoop, RenderSettings

UNIFORM_SEED, TEST_SEED = 3_000_000, 0
"""First seed of the uniform check, one per chunk, and the seed of the test renders."""
REGIONS = ("frame", "insets")


def main() -> int:
    args = parse()
    scenes = load_scenes(args)
    check_writable(args.out / "evaluation.json")
    deadline = time.monotonic() + args.time_limit
    results = {}
    for scene in scenes:
        first, second, uniform = long_renders(scene, args, deadline)
        wanted = (args.reference_spp // 2, args.reference_spp // 2, args.uniform_spp)
        if any(render.spp < spp for render, spp in zip((first, second, uniform), wanted)) or time.monotonic() > deadline:
            print(f"{scene.name}: time limit reached at {first.spp} + {second.spp} of {args.reference_spp} SPP of the reference")
            print(f"and {uniform.spp} of {args.uniform_spp} SPP of uniform sampling; the same command continues\n")
            continue
        reference = LongRender(
            (first.radiance + second.radiance) / 2, (first.variance + second.variance) / 4, first.spp + second.spp
        )
        facts = judge_reference(scene, first, second, reference, uniform)
        results[scene.name] = {"reference": facts, "modes": judge_modes(scene, reference.radiance, args)}
        settings = {name: str(value) for name, value in vars(args).items()}
        write_json(args.out / "evaluation.json", {"settings": settings, "scenes": results})
    if results:
        text = "\n\n".join(tables(results, args))
        write_text(args.out / "evaluation.md", text + "\n")
        print(text)
    return 0 if len(results) == len(scenes) else 1


def parse() -> argparse.Namespace:
    parser = experiment_parser(__doc__, "640x360", ",".join(LENS_MODES))
    add = parser.add_argument
    add("--spp", type=numbers, default=[64, 256], metavar="N,N", help="SPP at which errors are measured (default: 64,256)")
    add("--cache", type=Path, metavar="DIR", help="folder of the references (default: the user's cache folder)")
    add("--reference-spp", type=positive, default=4096, metavar="N", help="SPP of both halves together (default: 4096)")
    add("--uniform-spp", type=positive, default=1024, metavar="N", help="SPP of the check by uniform sampling (default: 1024)")
    add("--out", type=Path, default=Path("out/evaluation"), metavar="DIR", help="folder of the results (default: out/evaluation)")
    args = parser.parse_args()
    # All ratios are to uniform sampling.
    args.modes = ["uniform", *(mode for mode in args.modes if mode != "uniform")]
    return args


def long_renders(scene: Scene, args: argparse.Namespace, deadline: float) -> list[LongRender]:
    """The two halves of the reference and the uniform render, as far as the deadline allows."""
    half = RenderSettings(spp=args.reference_spp // 2, threads=args.threads)
    uniform = RenderSettings("uniform", args.uniform_spp, UNIFORM_SEED, threads=args.threads)
    halves = rendered_halves(scene, half, args.cache, deadline)
    path = half_files(scene, args.cache)[0].with_name(f"{scene.name}-uniform.exr")
    return [*halves, accumulate(path, scene, uniform, CHUNK, deadline)]


def judge_reference(
    scene: Scene, first: LongRender, second: LongRender, reference: LongRender, uniform: LongRender
) -> dict[str, Any]:
    """Errors between the halves, and the ratio to uniform sampling, by region."""
    facts: dict[str, Any] = {"spp": reference.spp, "uniform_spp": uniform.spp}
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
            spp: {region: errors(image, reference, mask) for region, mask in masks(scene).items()}
            for spp, image in by_spp.items()
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
    settings = RenderSettings(mode, max(args.spp), TEST_SEED, threads=args.threads)
    images, title = {}, f"{scene.name} {mode}"
    with progress(title, max(args.spp)) as bar, RenderLoop(scene, settings) as loop:
        for step in range(1, max(args.spp) + 1):
            whole_step(loop)
            bar.update()
            if step in args.spp:
                images[step] = loop.film.radiance().cpu()
    warn_of_bad_samples(loop.film, title)
    return images


def masks(scene: Scene) -> dict[str, Tensor]:
    """The pixels of each of REGIONS that the scene has, bool `[H, W]`."""
    found = regions(scene)
    return {region: found[region] for region in REGIONS if region in found}


def tables(results: dict[str, dict], args: argparse.Namespace) -> list[str]:
    """Markdown: one table of the references, then for each SPP one of the frame and one of the insets."""
    heads = [f"{region}: {column}" for region in REGIONS for column in ("halves", "/ uniform", "z")]
    rows = [["scene", "SPP", "uniform SPP", *heads]]
    for name, result in results.items():
        facts = result["reference"]
        row = [name, str(facts["spp"]), str(facts["uniform_spp"])]
        for region in (facts.get(region) for region in REGIONS):
            if region is None:
                row += ["", "", ""]
                continue
            ratio = f"{region['over_uniform']:.5f} ± {region['standard_error']:.5f}"
            row += [f"{region['halves_mape']:.5f}", ratio, f"{region['z']:+.2f}"]
        rows.append(row)
    made = ["References: MAPE between the halves, mean luminance over that of uniform sampling\n\n" + markdown(rows)]
    for spp in args.spp:
        for region in REGIONS:
            rows = [["scene", *args.modes]]
            for name, result in results.items():
                if region not in result["reference"]:
                    continue
                mapes = [result["modes"][mode][spp][region]["mape"] for mode in args.modes]
                cells = [f"{value:.5f} ({value / mapes[0]:.3f})" for value in mapes[1:]]
                rows.append([name, f"{mapes[0]:.5f}", *cells])
            if len(rows) > 1:
                made.append(f"MAPE over the {region} at {spp} SPP (ratio to uniform)\n\n{markdown(rows)}")
    return made


if __name__ == "__main__":
    run(main, "the same command continues the references")
