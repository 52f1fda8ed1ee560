"""Fig. 6: fixed and learned β (lis and lis-b) with occluded highlights.

    python scripts/figures/fig6.py

Writes fig6.png, crops beside the reference with their MAPE above the learned β of lis-b, fig6.md and fig6.json. The fixed β
are 0.95, as in the paper's Fig. 6, and 0.8, the default of mode lis.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

from common import Variant, compared, figure_options, relabelled, settings, write_numbers
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from bokehguide.cli.scripts import run
from bokehguide.evaluation import Comparison, regions
from bokehguide.evaluation.crops_figure import COLORS, GAP, MARGIN, draw_scene, lay_out
from bokehguide.evaluation.page import NORMAL, SMALL, WIDTH, save
from bokehguide.guiding.config import GaussianConfig
from bokehguide.image import Display
from bokehguide.scene import Inset, Scene
from bokehguide.train import RenderLoop, RenderSettings

FIXED = Variant("lis, β 0.95", "lis", "high-beta", GaussianConfig(blend=0.95))
LABELS = {FIXED.label: "lis\nβ = 0.95", "lis": "lis\nβ = 0.8", "lis-b": "lis-b\nβ learned"}
MAP_GAP, BAR_WIDTH = 0.25, 0.08
"""Inches: space above the β maps, width of the colour bar."""


def main() -> None:
    options = figure_options(__doc__, ["occluded"])
    comparisons = compared([FIXED, "lis", "lis-b"], options)
    maps = [learned_beta(comparison.scene, settings("lis-b", options)) for comparison in comparisons]
    write_figure(options.out / "fig6.png", [relabelled(comparison, LABELS) for comparison in comparisons], maps)
    means = {one.scene.name: {"mean_beta": means_by_region(one, beta)} for one, beta in zip(comparisons, maps)}
    write_numbers(comparisons, options.out / "fig6.json", means)
    print(f"wrote {options.out / 'fig6.png'} and .json")


def learned_beta(scene: Scene, whole: RenderSettings) -> Tensor:
    """β `[H, W]` at the end of a render, 0 without candidates. No file has it, so the scene is rendered again."""
    with RenderLoop(scene, whole) as loop:
        for _ in range(whole.spp):
            loop.step()
    return loop.guide_images()["beta"][..., 0].cpu()


def means_by_region(comparison: Comparison, beta: Tensor) -> dict[str, float]:
    """Mean β of the guided pixels by region."""
    masks = {region: mask & (beta > 0.0) for region, mask in regions(comparison.scene).items()}
    return {region: float(beta[mask].mean()) for region, mask in masks.items() if mask.any()}


def write_figure(path: Path, comparisons: Sequence[Comparison], maps: Sequence[Tensor]) -> None:
    """Write the crops of each scene, and below them β over the frame and in the insets."""
    layouts = [lay_out(comparison) for comparison in comparisons]
    rows = [map_height(comparison.scene) for comparison in comparisons]
    figure = Figure((WIDTH, sum(layout.height + MAP_GAP + row + 0.08 for layout, row in zip(layouts, rows))))
    top = 0.0
    for comparison, layout, row, beta in zip(comparisons, layouts, rows, maps):
        draw_scene(figure, comparison, layout, top + layout.head, Display())
        top += layout.height + MAP_GAP
        draw_maps(figure, comparison.scene, beta, top, row)
        top += row + 0.08
    save(figure, path)


def map_boxes(scene: Scene) -> list[tuple[slice, slice]]:
    """Slices of the frame and of each inset."""
    boxes = (Inset(0.0, 0.0, 1.0, 1.0), *scene.insets)
    return [box.pixels(scene.film.width, scene.film.height) for box in boxes]


def map_widths(scene: Scene) -> list[float]:
    """Widths of `map_boxes` at height 1."""
    return [(columns.stop - columns.start) / (rows.stop - rows.start) for rows, columns in map_boxes(scene)]


def map_height(scene: Scene) -> float:
    """Height in inches of a row of maps across the page."""
    widths = map_widths(scene)
    return (WIDTH - 2 * MARGIN - GAP * len(widths) - BAR_WIDTH - 0.25) / sum(widths)


def draw_maps(figure: Figure, scene: Scene, beta: Tensor, top: float, height: float) -> None:
    """Draw a row `top` inches below the page's edge: β over the frame with its insets, β of each inset, and the colour bar."""
    left, page = MARGIN, figure.get_size_inches()[1]
    boxes = map_boxes(scene)
    for number, (box, width) in enumerate(zip(boxes, map_widths(scene))):
        place = (left / WIDTH, 1.0 - (top + height) / page, height * width / WIDTH, height / page)
        axes = figure.add_axes(place, xticks=(), yticks=())
        shown = axes.imshow(beta[box].numpy(), cmap="viridis", vmin=0.0, vmax=1.0, interpolation="nearest", aspect="auto")
        if number == 0:
            axes.set_title("learned β (0: no highlight on the lens)", fontsize=NORMAL, pad=3, loc="left")
            for color, (rows, columns) in zip(cycle(COLORS), boxes[1:]):
                corner, size = (columns.start - 0.5, rows.start - 0.5), (columns.stop - columns.start, rows.stop - rows.start)
                axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=color, linewidth=1.0))
        else:
            axes.spines[:].set(edgecolor=COLORS[(number - 1) % len(COLORS)], linewidth=1.0)
        left += height * width + GAP
    bar = figure.add_axes((left / WIDTH, 1.0 - (top + height) / page, BAR_WIDTH / WIDTH, height / page))
    figure.colorbar(shown, cax=bar).ax.tick_params(labelsize=SMALL)


if __name__ == "__main__":
    run(main, "finished renders are kept, and the same command continues")
