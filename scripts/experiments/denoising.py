"""Measure the denoiser: MAPE of noisy and denoised pictures at several SPP, with and without pixel reuse.

    python scripts/experiments/denoising.py --out out/denoising fairy-lights cutout
    python scripts/experiments/denoising.py --out out/denoising model.glb --environment map.hdr
    python scripts/experiments/denoising.py --out out/denoising real-chess real-helmet

Each scene is rendered without reuse, as `--denoise` does, and with the groups of a render without a denoiser. The halves and the
auxiliary layers at 4, 16, 64 and 256 SPP are kept in the output folder, with a reference of another seed. Kept renders are not
repeated. The table has the MAPE of all kept renders: noisy, denoised without halves, mixed by halves (`--denoise`), mixed by
variance (`develop --denoise`); and the estimate of `--denoise`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from real_scenes import REAL_SCENES, load_any

from bokehguide.cli.parser import Parser, positive, size
from bokehguide.cli.scripts import run
from bokehguide.guiding.config import GuidedConfig
from bokehguide.image.denoise import denoise_by_variance, denoise_halves
from bokehguide.image.oidn import Denoiser
from bokehguide.metrics import mape
from bokehguide.render.split_film import relative_error
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import RenderLoop, RenderSettings

COUNTS = (4, 16, 64, 256)
LAYERS = ("albedo", "normal", "emission", "alpha", "variance")
SETTINGS = {
    "no reuse": RenderSettings(denoise=True),
    "reuse": RenderSettings(denoise=True, guided=GuidedConfig(denoised_reuse_group=GuidedConfig.reuse_group)),
    "uniform": RenderSettings(mode="uniform", denoise=True),
}
REFERENCE_SEED = 770_000


def main() -> None:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="built-in scenes, real pictures, scene files or models to render")
    parser.add_argument("--size", type=size, default="160x90", metavar="WxH", help="default: 160x90")
    parser.add_argument("--environment", metavar="MAP", help="map for models")
    parser.add_argument("--reference-spp", type=positive, default=4096, metavar="N", help="default: 4096")
    parser.add_argument("--variants", default="no reuse,reuse", help="of no reuse, reuse, uniform (default: no reuse,reuse)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the renders")
    args = parser.parse_args()
    for name in args.scenes:
        given = Overrides(*args.size, environment=args.environment)
        scene = load_any(name, *args.size) if name in REAL_SCENES else load_scene(name, given)
        folder = args.out / f"{scene.name}-{args.size[0]}x{args.size[1]}"
        render_all(scene, folder, args.variants.split(","), args.reference_spp)
    print_table(args.out)


def print_table(out: Path) -> None:
    """MAPE of all kept renders, as Markdown."""
    print("| scene | render | SPP | noisy | D(N) | halves | by variance | estimated |")
    print("|---|---|---:|---:|---:|---:|---:|---:|")
    for folder in sorted(path.parent for path in out.glob("*/reference.npz")):
        reference = picture_of(np.load(folder / "reference.npz"))
        for variant in SETTINGS:
            for count in COUNTS:
                path = folder / f"{variant}-{count}.npz"
                if path.exists():
                    errors = " | ".join(f"{value:.4f}" for value in measured(np.load(path), reference))
                    print(f"| {folder.name} | {variant} | {count} | {errors} |", flush=True)


def picture_of(kept: Mapping[str, np.ndarray]) -> np.ndarray:
    """The mean of the halves."""
    share = kept["share"][..., None]
    return share * kept["first"] + (1.0 - share) * kept["second"]


def measured(kept: Mapping[str, np.ndarray], reference: np.ndarray) -> list[float]:
    """MAPE of the noisy picture, of the denoised one alone, of both mixtures, and the estimate for the mixture of halves."""
    first, second, share, albedo, normal = (kept[name] for name in ("first", "second", "share", "albedo", "normal"))
    noisy = picture_of(kept)
    seen = kept["first_emission"], kept["second_emission"]
    mixed = denoise_halves(first, second, share, albedo, normal, seen, kept["variance"])
    other = denoise_by_variance(noisy, kept["variance"], albedo, normal)
    pictures = (noisy, Denoiser(albedo, normal)(noisy), mixed.radiance, other.radiance)
    halves = (torch.from_numpy(half).permute(2, 0, 1) for half in (first, second))
    estimated = relative_error(*halves, torch.from_numpy(share)).permute(1, 2, 0).numpy() * mixed.error_ratio[..., None]
    truth = torch.from_numpy(reference)
    return [*(mape(torch.from_numpy(picture), truth) for picture in pictures), float(estimated.mean())]


def render_all(scene: Scene, folder: Path, variants: list[str], reference_spp: int) -> None:
    """The renders of a scene that `folder` lacks."""
    folder.mkdir(parents=True, exist_ok=True)
    for variant in variants:
        if not (folder / f"{variant}-{COUNTS[-1]}.npz").exists():
            render_counts(scene, folder, variant)
    settings = replace(SETTINGS["reuse"], seed=REFERENCE_SEED, spp=reference_spp)
    if not (folder / "reference.npz").exists():
        with RenderLoop(scene, settings) as loop:
            for _ in range(reference_spp):
                loop.step()
            save(folder / "reference.npz", loop)


def render_counts(scene: Scene, folder: Path, variant: str) -> None:
    """One render, kept at all COUNTS."""
    seconds = 0.0
    with RenderLoop(scene, SETTINGS[variant]) as loop:
        for step in range(1, COUNTS[-1] + 1):
            seconds += loop.step().seconds
            if step in COUNTS:
                save(folder / f"{variant}-{step}.npz", loop, seconds)


def save(path: Path, loop: RenderLoop, seconds: float = 0.0) -> None:
    """Write halves and layers, atomically."""
    layers = loop.film.layers()
    halves = {name: half.numpy() for name, half in loop.film.halves()._asdict().items()}
    temporary = path.with_suffix(".tmp.npz")
    np.savez(temporary, seconds=seconds, **halves, **{name: layers[name] for name in LAYERS})
    temporary.replace(path)


if __name__ == "__main__":
    run(main)
