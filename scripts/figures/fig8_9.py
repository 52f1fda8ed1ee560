"""Fig. 8 and 9: all methods on four scenes, as crops with their MAPE and as convergence.

    python scripts/figures/fig8_9.py

Writes fig8.png, the crops; fig9.png, MAPE over the insets against SPP and against time; fig8_9.md; fig8_9.json. Area ReSTIR
traces about forty times the rays of the other modes and gets a quarter of their SPP. Its crops show its SPP.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from common import Variant, compared, figure_options, relabelled, write_numbers
from matplotlib.figure import Figure

from bokehguide.cli.scripts import run
from bokehguide.evaluation import Comparison
from bokehguide.evaluation.crops_figure import write_crops
from bokehguide.evaluation.curves_figure import COSTS, add_legend, draw_curves
from bokehguide.evaluation.page import NORMAL, SMALL, WIDTH, save

SCENES = ("fairy-lights", "occluded", "chrome", "night-street")
RESTIR = Variant("area-restir", "area-restir", "fewer-spp", spp_divisor=4)
METHODS = ("uniform", RESTIR, "lis", "lis-b", "lis-o", "guided")
"""The methods of the paper in its order, and `guided`."""


def main() -> None:
    options = figure_options(__doc__, SCENES)
    comparisons = compared(METHODS, options)
    labels = {RESTIR.label: f"{RESTIR.label}\n{comparisons[0].runs[RESTIR.label].spp} SPP"}
    write_crops(options.out / "fig8.png", [relabelled(comparison, labels) for comparison in comparisons])
    write_curves(options.out / "fig9.png", comparisons)
    write_numbers(comparisons, options.out / "fig8_9.json")
    print(f"wrote fig8.png, fig9.png and fig8_9.json into {options.out}")


def write_curves(path: Path, comparisons: Sequence[Comparison]) -> None:
    """Write a figure with a column for each scene and a row for each cost."""
    figure = Figure((WIDTH, 4.2), layout="constrained")
    rows = figure.subplots(len(COSTS), len(comparisons), sharey="col", squeeze=False)
    for row, cost in zip(rows, COSTS):
        for axes, comparison in zip(row, comparisons):
            draw_curves(axes, comparison, "insets", cost)
            axes.set_xlabel(cost, fontsize=NORMAL)
        row[0].set_ylabel("MAPE, insets", fontsize=NORMAL)
    for axes, comparison in zip(rows[0], comparisons):
        axes.set_title(comparison.scene.name, fontsize=NORMAL)
    add_legend(figure)
    figure.supxlabel(f"{RESTIR.label} has 1/{RESTIR.spp_divisor} of the samples per pixel of the other modes", fontsize=SMALL)
    save(figure, path)


if __name__ == "__main__":
    run(main, "finished renders are kept, and the same command continues")
