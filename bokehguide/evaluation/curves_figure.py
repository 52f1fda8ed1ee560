"""Convergence as a figure for a paper: error over SPP and over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, Locator, LogLocator, MaxNLocator, NullFormatter

from bokehguide.evaluation.comparison import Comparison
from bokehguide.evaluation.page import NORMAL, SMALL, WIDTH, save
from bokehguide.evaluation.runs import Run
from bokehguide.train import MODES

COLORS = ("#4d4d4d", "#e69f00", "#0072b2", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#b2a400")
DASHES = ("-", "-", (0, (6, 2)), (0, (3, 1.5)), "-.", (0, (6, 1.5, 1, 1.5)), (0, (1, 1)), "-")
"""Of the modes, the same in all figures: colours of Okabe and Ito for colour-blind readers; dashes show coinciding curves."""
FLOOR = 1e-6
"""Least drawn error, as log axes have no 0; a scene of constant radiance has errors of 0."""
COSTS: dict[str, Callable[[Run], Sequence[float]]] = {
    "samples per pixel": lambda run: range(1, run.spp + 1),
    "seconds": lambda run: run.seconds,
}


def write_convergence(path: Path, comparison: Comparison) -> None:
    """Write a figure of MAPE over SPP and over time, of the insets if the scene has any, and of the frame."""
    measured = next(iter(comparison.runs.values())).errors
    regions = [region for region in ("insets", "frame") if region in measured]
    figure = Figure((WIDTH, 0.5 + 2.2 * len(regions)), layout="constrained")
    axes = figure.subplots(len(regions), len(COSTS), sharex="col", sharey="row", squeeze=False)
    for row, region in zip(axes, regions):
        for one, cost in zip(row, COSTS):
            draw_curves(one, comparison, region, cost)
        row[0].set_ylabel(f"MAPE, {region}", fontsize=NORMAL)
    for one, cost in zip(axes[-1], COSTS):
        one.set_xlabel(cost, fontsize=NORMAL)
    film = comparison.scene.film
    axes[0, 0].set_title(f"{comparison.scene.name}, {film.width}×{film.height}", fontsize=NORMAL, loc="left")
    add_legend(figure)
    save(figure, path)


def draw_curves(axes: Axes, comparison: Comparison, region: str, cost: str) -> None:
    """Draw MAPE of all modes over one of COSTS on log axes, and the reference's own error if it is in view."""
    axes.set_xscale("log", base=10 if cost == "seconds" else 2)
    axes.set_yscale("log")
    for mode, run in comparison.runs.items():
        number = list(MODES).index(mode) % len(COLORS)
        style = {"color": COLORS[number], "linestyle": DASHES[number], "linewidth": 1.2}
        end = {"marker": "o", "markersize": 3, "markevery": [-1]}
        error = [max(value, FLOOR) for value in run.errors[region]["mape"]]
        axes.plot(list(COSTS[cost](run)), error, label=mode, **style, **end)
    own = comparison.reference.own_error(region)
    if own and own > axes.get_ylim()[0]:
        axes.axhline(own, color="#999999", linewidth=0.9, linestyle=":", label="the reference's own error")
    for axis in (axes.xaxis, axes.yaxis):
        label(axis, cost == "seconds" or axis is axes.yaxis)
    axes.grid(True, color="#e5e5e5", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=SMALL)


def label(axis: Axis, at_round_numbers: bool = True) -> None:
    """Plain numbers at a log axis: four to eight at round values, or at the present ticks."""
    if at_round_numbers:
        axis.set_major_locator(locator(*axis.get_view_interval()))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def locator(low: float, high: float) -> Locator:
    """Four to eight ticks at round numbers on a log axis from `low` to `high`."""
    if high < 5.0 * low:
        return MaxNLocator(5, steps=(1, 2, 5, 10))
    return LogLocator(10, subs=(1, 2, 5) if high < 200.0 * low else (1,))


def add_legend(figure: Figure) -> None:
    """Draw one line of legend above all axes."""
    entries = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles))
    look = {"fontsize": SMALL, "frameon": False, "handlelength": 2.8}
    figure.legend(entries.values(), entries.keys(), loc="outside upper center", ncols=min(len(entries), 7), **look)
