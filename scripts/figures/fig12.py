"""Fig. 12, a failure case: alpha of guided renders, over an empty background (cutout) and over an opaque one (fairy-lights).

    python scripts/figures/fig12.py

Writes fig12.png, crops of alpha beside the reference, fig12.md and fig12.json: mean absolute error, mean error with its
standard error over the pixels, and the share of pixels outside 0 … 1, by region. One render of lis-o gives three estimates
of alpha:

- counted: the share of all draws that hit a surface. Draws outside the lens count as empty and draws inside have no weight.
  This estimate is biased, with the circles of the paper's figure;
- weighted: the mean of w alpha, w = 1 / (A q). This estimate is unbiased, noisy, and often above 1;
- lis-o: the estimate of the film, with a control variate. It is unbiased, and exact if all surfaces are opaque.

`guided` has the estimate of the film. Draws of uniform sampling have equal weights.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from common import figure_options, settings, sized, write_json, write_table
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from torch import Tensor

from bokehguide.cli.scripts import run
from bokehguide.evaluation import markdown, progress, regions
from bokehguide.evaluation.page import NORMAL, SMALL, WIDTH, save
from bokehguide.render.film import Film, FilmSamples
from bokehguide.runtime.indexing import Pixels
from bokehguide.scene import Inset, Scene
from bokehguide.train import RenderLoop, RenderSettings

REFERENCE_SHARE, REFERENCE_SEED = 16, 6_000_000
"""SPP of the reference per SPP of a mode, and its seed. The reference is uniform and without bounces."""
BELOW, ABOVE = "#0072b2", "#d55e00"
"""Colours of alpha below 0 and above 1."""
ROUNDING = 1e-5
"""Tolerance of alpha outside 0 … 1."""
SHOWN = 3
"""Rows of a scene: its frame and SHOWN - 1 insets."""
LABELS = {"counted": "lis-o\ncounted", "weighted": "lis-o\nweighted", "lis-o": "lis-o\ncontrol variate"}


class AlphaFilm(Film):
    """A film with two further estimates of alpha, as sums over the steps `[H · W]`."""

    def __init__(self, width: int, height: int):
        super().__init__(width, height)
        self.counted, self.weighted = torch.zeros(2, width * height)

    def add(self, pixels: Pixels, samples: FilmSamples, *step: object) -> Tensor:
        self.counted[pixels] += samples.alpha * (samples.weight > 0.0)
        self.weighted[pixels] += samples.alpha * samples.weight
        return super().add(pixels, samples, *step)


def main() -> None:
    options = figure_options(__doc__, ["cutout", "fairy-lights"])
    scenes = [sized(name, options) for name in options.scenes]
    alphas = [alphas_of(scene, options) for scene in scenes]
    write_figure(options.out / "fig12.png", scenes, alphas)
    numbers = {scene.name: {"spp": options.spp, "alpha": measured(scene, found)} for scene, found in zip(scenes, alphas)}
    write_json(numbers, options.out / "fig12.json")
    tables = [alpha_table(scene, measured(scene, found)) for scene, found in zip(scenes, alphas)]
    write_table(tables, options.out / "fig12.json")
    print(f"wrote {options.out / 'fig12.png'} and .json")


def alpha_table(scene: Scene, errors: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Errors of alpha over the frame, by estimate."""
    rows = [[scene.name, "mean absolute error", "mean error ± standard error", "pixels outside 0 to 1"]]
    for name, by_region in errors.items():
        one = by_region["frame"]
        bias = f"{one['mean error']:+.5f} ± {one['its standard error']:.5f}"
        label = LABELS.get(name, name).replace("\n", ", ")
        rows.append([label, f"{one['mean absolute error']:.4f}", bias, f"{one['outside 0 to 1']:.2%}"])
    return markdown(rows)


def alphas_of(scene: Scene, options: argparse.Namespace) -> dict[str, Tensor]:
    """Alpha `[H, W]` by estimate, the reference last."""
    films = {mode: rendered(scene, settings(mode, options)) for mode in ("uniform", "lis-o", "guided")}
    shape, lis = (scene.film.height, scene.film.width), films["lis-o"]
    sums = {"counted": lis.counted, "weighted": lis.weighted}
    plain = {name: (total / options.spp).reshape(shape) for name, total in sums.items()}
    alphas = {mode: torch.from_numpy(film.layers()["alpha"]) for mode, film in films.items()}
    # Alpha depends on primary hits alone.
    unlit = replace(scene, film=replace(scene.film, max_depth=1))
    long = replace(settings("uniform", options), spp=REFERENCE_SHARE * options.spp, seed=REFERENCE_SEED)
    reference = torch.from_numpy(rendered(unlit, long).layers()["alpha"])
    return {"uniform": alphas.pop("uniform"), **plain, **alphas, "reference": reference}


def rendered(scene: Scene, settings: RenderSettings) -> AlphaFilm:
    """The film of one render."""
    title = f"{scene.name} {settings.mode}"
    with progress(title, settings.spp) as bar, RenderLoop(scene, settings) as loop:
        loop.film = AlphaFilm(scene.film.width, scene.film.height)
        for _ in range(settings.spp):
            loop.step()
            bar.update()
    return loop.film


def measured(scene: Scene, alphas: Mapping[str, Tensor]) -> dict[str, dict[str, dict[str, float]]]:
    """Errors of each estimate by region."""
    found = {}
    for name in (name for name in alphas if name != "reference"):
        found[name] = {}
        for region, mask in regions(scene).items():
            alpha = alphas[name][mask].double()
            error = alpha - alphas["reference"][mask]
            found[name][region] = {
                "mean absolute error": float(error.abs().mean()),
                "mean error": float(error.mean()),
                "its standard error": float(error.std(correction=0)) / len(error) ** 0.5,
                "outside 0 to 1": float(((alpha < -ROUNDING) | (alpha > 1.0 + ROUNDING)).double().mean()),
            }
    return found


def write_figure(path: Path, scenes: Sequence[Scene], alphas: Sequence[Mapping[str, Tensor]]) -> None:
    """Write alpha by estimate: for each scene a row of frames and a row for each inset, with mean absolute errors."""
    rows = [(scene, found, region) for scene, found in zip(scenes, alphas) for region in list(crops(scene))[:SHOWN]]
    heights = [crop_height(*crops(scene)[region]) for scene, _, region in rows]
    names = list(alphas[0])
    figure = Figure((WIDTH, WIDTH / len(names) * sum(heights) + 0.19 * len(rows) + 0.55), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.01, h_pad=0.02, wspace=0.01, hspace=0.01)
    axes = figure.subplots(len(rows), len(names), squeeze=False, height_ratios=heights)
    for row, (scene, found, region) in zip(axes, rows):
        errors = {name: facts[region]["mean absolute error"] for name, facts in measured(scene, found).items()}
        for one, name in zip(row, names):
            one.imshow(grey(found[name][crops(scene)[region]]), interpolation="nearest")
            one.set(xticks=[], yticks=[])
            text = f"{errors[name]:.4f}" if name in errors else f"{scene.name}, {region.replace('-', ' ')}"
            one.set_xlabel(text, fontsize=SMALL, labelpad=2)
    for one, name in zip(axes[0], names):
        one.set_title(LABELS.get(name, name), fontsize=NORMAL, pad=3)
    note = Patch(alpha=0.0, label="below each: mean |error|")
    marks = [note, Patch(color=BELOW, label="alpha below 0"), Patch(color=ABOVE, label="alpha above 1")]
    figure.legend(handles=marks, loc="outside lower center", ncols=3, fontsize=SMALL, frameon=False)
    save(figure, path)


def crops(scene: Scene) -> dict[str, tuple[slice, slice]]:
    """Slices of the frame and of each inset, by the names of `regions`."""
    insets = {f"inset-{number}": inset for number, inset in enumerate(scene.insets, start=1)}
    boxes = {"frame": Inset(0.0, 0.0, 1.0, 1.0), **insets}
    return {region: box.pixels(scene.film.width, scene.film.height) for region, box in boxes.items()}


def crop_height(rows: slice, columns: slice) -> float:
    """Height of a crop of width 1."""
    return (rows.stop - rows.start) / (columns.stop - columns.start)


def grey(alpha: Tensor) -> np.ndarray:
    """Alpha `[H, W]` in grey, and in BELOW or ABOVE out of range, `[H, W, 3]`."""
    picture = np.repeat(alpha.clamp(0.0, 1.0).numpy()[..., None], 3, axis=2)
    picture[(alpha < -ROUNDING).numpy()] = to_rgb(BELOW)
    picture[(alpha > 1.0 + ROUNDING).numpy()] = to_rgb(ABOVE)
    return picture


if __name__ == "__main__":
    run(main, "finished renders are kept, and the same command continues")
