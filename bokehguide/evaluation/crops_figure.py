"""Crops of several modes side by side, as a figure for a paper. Lengths are inches, from the top left corner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from bokehguide.evaluation.comparison import Comparison
from bokehguide.evaluation.page import NORMAL, SMALL, WIDTH, save
from bokehguide.image import Display, to_8_bit
from bokehguide.scene.types import Inset

COLORS = ("#ff2d55", "#00a5ff", "#ffb000", "#3ddc84")
"""Colours of the insets."""
MARGIN, GAP, FRAME_GAP, LABEL, HEAD = 0.02, 0.04, 0.1, 0.14, 0.06
"""At the sides, between crops, between frame and crops, of a line of text, above the first line."""

LEAST_CROP, MOST_HEIGHT = 0.3, 20.0
"""Least width of a crop beside the frame, below which the frame is left out; largest height of a column of crops."""

Box = tuple[slice, slice]


@dataclass(frozen=True)
class Layout:
    """The part of the page of one scene; the frame is as high as the column of crops beside it, or 0 × 0."""

    boxes: Sequence[Box]
    crop_width: float
    crop_heights: Sequence[float]
    frame_width: float
    frame_height: float
    names: Sequence[str]

    @property
    def head(self) -> float:
        """The height of the names, of one line or two."""
        return HEAD + LABEL * max(name.count("\n") + 1 for name in self.names)

    @property
    def letters(self) -> float:
        """Font size in points at which the longest name is as wide as a crop; a letter is 0.6 times as wide as high."""
        longest = max(len(line) for name in self.names for line in name.split("\n"))
        return min(NORMAL, 72.0 * self.crop_width / (0.6 * longest))

    @property
    def height(self) -> float:
        return self.head + sum(self.crop_heights) + len(self.boxes) * LABEL + GAP


def write_crops(path: Path, comparisons: Sequence[Comparison], display: Display = Display()) -> None:
    """Write a figure with the reference of each scene, its insets, and the crops of all modes with their MAPE.

    A scene without insets shows its whole frames in a row. All pictures of a
    scene have the exposure that suits its reference.
    """
    layouts = [lay_out(comparison) for comparison in comparisons]
    figure = Figure((WIDTH, sum(layout.height for layout in layouts)))
    top = 0.0
    for comparison, layout in zip(comparisons, layouts):
        draw_scene(figure, comparison, layout, top + layout.head, display)
        top += layout.height
    save(figure, path)


def lay_out(comparison: Comparison) -> Layout:
    """A layout with the widest crops that fit beside the frame."""
    film = comparison.scene.film
    insets = comparison.scene.insets or (Inset(0.0, 0.0, 1.0, 1.0),)
    boxes = [inset.pixels(film.width, film.height) for inset in insets]
    heights = [(rows.stop - rows.start) / (columns.stop - columns.start) for rows, columns in boxes]
    names = [mode.replace("+", "+\n") for mode in (*comparison.runs, "reference")]
    free = WIDTH - 2 * MARGIN - (len(names) - 1) * GAP
    shape, labels = film.width / film.height, (len(boxes) - 1) * LABEL
    width = (free - FRAME_GAP - shape * labels) / (len(names) + shape * sum(heights))
    framed = bool(comparison.scene.insets) and width > LEAST_CROP
    width = min(width if framed else free / len(names), MOST_HEIGHT / sum(heights))
    frame = width * sum(heights) + labels if framed else 0.0
    return Layout(boxes, width, [width * height for height in heights], shape * frame, frame, names)


def draw_scene(figure: Figure, comparison: Comparison, layout: Layout, top: float, display: Display) -> None:
    """The reference, and a row of crops for each inset."""
    reference = comparison.reference.radiance
    display = display.metered(reference)
    left = MARGIN
    if layout.frame_width:
        axes = draw_picture(figure, display.show(reference), (left, top, layout.frame_width, layout.frame_height))
        axes.set_title(f"{comparison.scene.name} (reference)", fontsize=NORMAL, pad=3)
        axes.set_xlabel(f"crops at {comparison.settings.spp} SPP", fontsize=SMALL, labelpad=2)
        for color, (rows, columns) in zip(cycle(COLORS), layout.boxes):
            width, height = columns.stop - columns.start, rows.stop - rows.start
            corner = (columns.start - 0.5, rows.start - 0.5)
            axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=color, linewidth=1.0))
        left += layout.frame_width + FRAME_GAP
    for name, mode in zip(layout.names, [*comparison.runs, None]):
        shown = display.show(comparison.images[mode] if mode else reference)
        first = draw_column(figure, comparison, layout, mode, shown, (left, top))
        first.set_title(name, fontsize=layout.letters, pad=3)
        left += layout.crop_width + GAP


def draw_column(
    figure: Figure, comparison: Comparison, layout: Layout, mode: str | None, display: Tensor, corner: tuple[float, float]
) -> Axes:
    """Draw the crops of one mode, or of the reference for None; the least error of a row is bold. Returns the first axes."""
    left, top = corner
    column = []
    for number, (color, box, height) in enumerate(zip(cycle(COLORS), layout.boxes, layout.crop_heights), start=1):
        axes = draw_picture(figure, display[box], (left, top, layout.crop_width, height))
        column.append(axes)
        region = f"inset-{number}" if comparison.scene.insets else "frame"
        errors = {mode: f"{run.errors[region]['mape'][-1]:.4f}" for mode, run in comparison.runs.items()}
        text = errors[mode] if mode else "MAPE"
        weight = "bold" if text == min(errors.values(), key=float) else "normal"
        axes.set_xlabel(text, fontsize=SMALL, labelpad=2, weight=weight)
        if comparison.scene.insets:
            for spine in axes.spines.values():
                spine.set(visible=True, edgecolor=color, linewidth=1.0)
        top += height + LABEL
    return column[0]


def draw_picture(figure: Figure, display: Tensor, box: tuple[float, float, float, float]) -> Axes:
    """Axes at (left, top, width, height) that show display values `[H, W, 3]` without interpolation."""
    left, top, width, height = box
    page_width, page_height = figure.get_size_inches()
    place = (left / page_width, 1.0 - (top + height) / page_height, width / page_width, height / page_height)
    axes = figure.add_axes(place, xticks=(), yticks=())
    axes.imshow(to_8_bit(display), interpolation="nearest", aspect="auto")
    axes.spines[:].set_visible(False)
    return axes
