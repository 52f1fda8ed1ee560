"""Fig. 11, a failure case: highlights at different depths that share cells of the record buffer, on glitter.

    python scripts/figures/fig11.py

Writes fig11.png, crops beside the reference with their MAPE, fig11.md and fig11.json. The columns: uniform sampling; lis-o
with one highlight per connected patch of cells, as in the paper, where one Gaussian spans several depths; lis-o, which splits
patches at gaps of depth; guided, which takes its emitters from the scene.
"""

from __future__ import annotations

import math

import torch
from common import Variant, compared, figure_options, relabelled, write_numbers

from bokehguide.cli.scripts import run
from bokehguide.evaluation.crops_figure import write_crops
from bokehguide.guiding.config import GaussianConfig, HighlightConfig
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene import Scene
from bokehguide.scene.emitters import find_emitters

UNSPLIT = Variant("lis-o, no split", "lis-o", "no-split", GaussianConfig(highlights=HighlightConfig(depth_gap=math.inf)))
LABELS = {UNSPLIT.label: "lis-o\nno split", "lis-o": "lis-o\nsplit by depth"}


def main() -> None:
    options = figure_options(__doc__, ["glitter"])
    comparisons = compared(["uniform", UNSPLIT, "lis-o", "guided"], options)
    write_crops(options.out / "fig11.png", [relabelled(comparison, LABELS) for comparison in comparisons])
    counts = {one.scene.name: {"emitters": shared_cells(one.scene)} for one in comparisons}
    write_numbers(comparisons, options.out / "fig11.json", counts)
    print(f"wrote {options.out / 'fig11.png'} and .json")


def shared_cells(scene: Scene) -> dict[str, int]:
    """Number of emitters in view of a pinhole, and number of emitters that touch another emitter beyond the depth gap of a split.

    Two emitters touch if they are less than a cell apart on the raster.
    """
    camera = ThinLensCamera(scene.camera, scene.film.width, scene.film.height)
    emitters = find_emitters(scene)
    near = ~emitters.infinite
    points = camera.axes.T @ (torch.from_numpy(emitters.centres[near]).float().T - camera.position)
    center, depth = camera.raster(points), points[2]
    cell = depth * camera.pixel_slope
    radius = torch.from_numpy(emitters.radii[near]).float() / cell
    size = torch.tensor([[camera.width], [camera.height]])
    shown = (depth > 0.0) & ((center > 0.0) & (center < size)).all(0)
    center, depth, cell, radius = center[:, shown], depth[shown], cell[shown], radius[shown]
    apart = torch.cdist(center.T, center.T) - radius[:, None] - radius
    leap = (depth[:, None] - depth).abs() > HighlightConfig.depth_gap * torch.minimum(cell[:, None], cell)
    return {"in sight": len(depth), "sharing cells": int(((apart < 1.0) & leap).any(1).sum())}


if __name__ == "__main__":
    run(main, "finished renders are kept, and the same command continues")
