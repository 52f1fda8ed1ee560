"""Fig. 11, a failure case: highlights at different depths that share cells of the record buffer, on glitter.

    python scripts/figures/fig11.py

Writes fig11.png, crops beside the reference with their MAPE, and fig11.json. The columns are:
uniform sampling; lis-o whose connected cells are always one highlight, as the paper
describes it, so that one Gaussian spans several depths; lis-o as it is, which splits them where
depths leap; and guided, whose lamps come from the scene and need no record.
"""

from __future__ import annotations

import math
from functools import partial
from unittest import mock

import torch
from common import Variant, compared, figure_options, relabelled, write_numbers

from bokehguide.cli.scripts import run
from bokehguide.evaluation.crops_figure import write_crops
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene import Scene
from bokehguide.scene.lamps import find_lamps
from bokehguide.train import fitting

UNSPLIT = Variant("lis-o, no split", "lis-o", "no-split", partial(mock.patch.object, fitting, "DEPTH_GAP", math.inf))
LABELS = {UNSPLIT.label: "lis-o\nno split", "lis-o": "lis-o\nsplit by depth"}


def main() -> None:
    options = figure_options(__doc__, ["glitter"])
    comparisons = compared(["uniform", UNSPLIT, "lis-o", "guided"], options)
    write_crops(options.out / "fig11.png", [relabelled(comparison, LABELS) for comparison in comparisons])
    counts = {one.scene.name: {"lamps": shared_cells(one.scene)} for one in comparisons}
    write_numbers(comparisons, options.out / "fig11.json", counts)
    print(f"wrote {options.out / 'fig11.png'} and .json")


def shared_cells(scene: Scene) -> dict[str, int]:
    """How many lamps the pinhole raster shows, and how many of them touch one there that lies a split's leap before or behind.

    Two lamps touch where they are less than a cell apart.
    """
    camera = ThinLensCamera(scene.camera, scene.film.width, scene.film.height)
    lamps = find_lamps(scene)
    near = ~lamps.infinite
    points = camera.axes.T @ (torch.from_numpy(lamps.centres[near]).float().T - camera.position)
    center, depth = camera.raster(points), points[2]
    cell = depth * camera.pixel_slope
    radius = torch.from_numpy(lamps.radii[near]).float() / cell
    size = torch.tensor([[camera.width], [camera.height]])
    shown = (depth > 0.0) & ((center > 0.0) & (center < size)).all(0)
    center, depth, cell, radius = center[:, shown], depth[shown], cell[shown], radius[shown]
    apart = torch.cdist(center.T, center.T) - radius[:, None] - radius
    leap = (depth[:, None] - depth).abs() > fitting.DEPTH_GAP * torch.minimum(cell[:, None], cell)
    return {"in sight": len(depth), "sharing cells": int(((apart < 1.0) & leap).any(1).sum())}


if __name__ == "__main__":
    run(main, "what is finished is kept, and the same command goes on")
