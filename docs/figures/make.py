"""Draw the diagrams of the explanation pages into docs/images.

python docs/figures/make.py
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import matplotlib
import numpy as np
import torch

matplotlib.use("svg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.patches import Circle, Ellipse, FancyBboxPatch, Polygon, Rectangle

from bokehguide.models.projection import lens_density

IMAGES = Path(__file__).parent.parent / "images"
INK, GREY, BLUE, ORANGE, GREEN, RED = "#222222", "#9a9a9a", "#2f6fb7", "#e07b00", "#2e8b57", "#c0392b"


def main() -> None:
    plt.rcParams |= {"svg.hashsalt": "bokehguide", "font.size": 11, "mathtext.fontset": "dejavusans", "figure.dpi": 100}
    IMAGES.mkdir(exist_ok=True)
    for draw in (thin_lens, footprint, lens_clips, map_rows, epochs, pixel_reuse, virtual_image, step, packages):
        save(draw)
    densities()


def save(draw: Callable[[], plt.Figure]) -> None:
    figure = draw()
    path = IMAGES / f"{draw.__name__.replace('_', '-')}.svg"
    figure.savefig(path, bbox_inches="tight", pad_inches=0.05, metadata={"Date": None})
    plt.close(figure)
    print(f"wrote {path}")


def canvas(width: float, height: float) -> tuple[plt.Figure, Axes]:
    """Axes without ticks, a unit of data an inch."""
    figure = plt.figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    axes.axis("off")
    return figure, axes


def lens(axes: Axes, x: float, y: float, radius: float) -> None:
    axes.add_patch(Ellipse((x, y), 0.22, 2 * radius, facecolor="#cfe3f7", edgecolor=BLUE, lw=1.4))


def label(axes: Axes, x: float, y: float, text: str, color: str = INK, **options: object) -> None:
    axes.text(x, y, text, color=color, **({"ha": "center", "va": "center"} | options))


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], color: str = INK, style: str = "-|>") -> None:
    properties = {"arrowstyle": style, "color": color, "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=end, xytext=start, arrowprops=properties)


def thin_lens() -> plt.Figure:
    """A highlight, its cone through the focus point, and the part of the lens that sees the highlight."""
    figure, axes = canvas(8.0, 3.4)
    x, middle, radius = 0.7, 1.7, 1.2
    focus, highlight, size = np.array([3.6, 1.7]), np.array([6.6, 2.15]), 0.14
    axes.plot((0.2, 7.9), (middle, middle), color=GREY, lw=0.8, ls=(0, (6, 4)))
    axes.plot((focus[0], focus[0]), (0.25, 3.15), color=GREY, lw=1.0)
    lens(axes, x, middle, radius)
    far = 7.6
    for edge in (middle - radius, middle + radius):
        slope = (focus[1] - edge) / (focus[0] - x)
        axes.plot((x, far), (edge, edge + slope * (far - x)), color=BLUE, lw=0.8)
    cone = [(x, middle + radius), tuple(focus), (x, middle - radius)]
    axes.add_patch(Polygon(cone, facecolor="#2f6fb7", alpha=0.06))
    reach = radius / (focus[0] - x) * (far - focus[0])
    axes.add_patch(Polygon([tuple(focus), (far, focus[1] + reach), (far, focus[1] - reach)], facecolor="#2f6fb7", alpha=0.06))
    hits = []
    for side in (-size, size):
        top = highlight + np.array([0.0, side])
        slope = (focus[1] - top[1]) / (focus[0] - top[0])
        hits.append(focus[1] + slope * (x - focus[0]))
        axes.plot((x, top[0]), (hits[-1], top[1]), color=ORANGE, lw=1.2)
    axes.add_patch(Circle(tuple(highlight), size, facecolor="#ffd28a", edgecolor=ORANGE, lw=1.4))
    axes.plot((x, x), hits, color=ORANGE, lw=5, solid_capstyle="butt")
    axes.plot(*focus, "o", color=INK, ms=5)
    label(axes, focus[0] + 0.28, focus[1] - 0.24, r"$x_F$")
    label(axes, x - 0.38, float(np.mean(hits)), r"$x_l$", ORANGE)
    label(axes, highlight[0] + 0.1, highlight[1] + 0.4, "highlight", ORANGE)
    label(axes, focus[0], 3.3, "focal plane", GREY)
    label(axes, x, 0.2, "lens, radius $r$", BLUE)
    for end, height, text in ((focus[0], 0.42, r"$d_F$"), (highlight[0], 0.12, r"$Z$")):
        arrow(axes, (x + 0.15, height), (end, height), GREY, "<|-|>") if text == r"$d_F$" else arrow(
            axes, (x + 1.0, height), (end, height), GREY, "-|>"
        )
        label(axes, 0.5 * (x + 1.0 + end), height + 0.17, text, GREY)
    return figure


def footprint() -> plt.Figure:
    """The pixels that see one highlight through the lens."""
    figure, axes = canvas(5.2, 3.2)
    pitch, center, radius = 0.2, np.array([2.5, 1.65]), 1.05
    for row in range(15):
        for column in range(25):
            corner = np.array([0.1 + column * pitch, 0.1 + row * pitch])
            inside = np.hypot(*(corner + pitch / 2 - center)) <= radius + 0.7072 * pitch
            color = "#ffe3b8" if inside else "white"
            axes.add_patch(Rectangle(tuple(corner), pitch, pitch, facecolor=color, edgecolor="#dddddd", lw=0.6))
    axes.add_patch(Circle(tuple(center), radius, fill=False, edgecolor=ORANGE, lw=1.6))
    axes.plot(*center, "o", color=ORANGE, ms=4)
    arrow(axes, tuple(center), (center[0] + radius * 0.92, center[1] + radius * 0.39), ORANGE)
    label(axes, center[0] + 0.45, center[1] + 0.42, r"$\rho$", ORANGE)
    label(axes, center[0], center[1] - 0.22, "pinhole projection", INK, fontsize=9)
    return figure


def lens_clips() -> plt.Figure:
    """The strip of an ellipse, and the interval of a parallelogram, that the lens sees."""
    figure, axes = canvas(8.0, 3.3)
    lens_center, radius = np.array([1.75, 1.65]), 1.2
    axes.add_patch(Circle(tuple(lens_center), radius, facecolor="#eaf2fb", edgecolor=BLUE, lw=1.6))
    angle, shape = np.linspace(0.0, 2.0 * np.pi, 200), np.array(((0.75, 0.0), (0.35, 0.6)))
    towards = np.array([np.cos(0.35), np.sin(0.35)])
    center = lens_center + 1.1 * towards
    outline = center + np.stack((np.cos(angle), np.sin(angle)), axis=1) @ shape.T
    inside = (outline - lens_center) @ towards <= radius
    axes.add_patch(Polygon(outline[inside], facecolor="#ffd28a", alpha=0.8, edgecolor="none"))
    axes.plot(*outline.T, color=ORANGE, lw=1.4)
    across = np.array([-towards[1], towards[0]])
    tangent = lens_center + radius * towards + np.array([[-1.1], [1.1]]) * across
    axes.plot(*tangent.T, color=INK, lw=1.2, ls=(0, (4, 3)))
    arrow(axes, tuple(lens_center), tuple(center), GREY)
    label(axes, *(lens_center - (0.25, 0.1)), "lens", BLUE)
    label(axes, 3.3, 0.85, "tangent", INK, fontsize=9)
    label(axes, 2.5, 1.55, "strip", INK, fontsize=9)
    lens_center = np.array([6.1, 1.65])
    axes.add_patch(Circle(tuple(lens_center), radius, facecolor="#eaf2fb", edgecolor=BLUE, lw=1.6))
    corners = np.array([[5.7, 0.65], [7.45, 1.1], [7.75, 2.65], [5.85, 2.35]])
    axes.add_patch(Polygon(corners, facecolor="#ffd28a", alpha=0.5, edgecolor=ORANGE, lw=1.4))
    low, high = corners[0] + 0.72 * (corners[1] - corners[0]), corners[3] + 0.72 * (corners[2] - corners[3])
    axes.plot(*np.stack((low, high)).T, color=GREY, lw=1.0, ls=(0, (3, 3)))
    line = low + np.linspace(0.0, 1.0, 400)[:, None] * (high - low)
    visible = line[np.hypot(*(line - lens_center).T) <= radius]
    axes.plot(*visible.T, color=INK, lw=2.4)
    label(axes, *(visible.mean(0) - (0.42, 0.0)), "interval", INK, fontsize=9)
    label(axes, low[0] + 0.05, low[1] - 0.2, "$a$", GREY)
    label(axes, *(lens_center - (0.75, 0.1)), "lens", BLUE)
    return figure


def map_rows() -> plt.Figure:
    """The rows of the environment map, and the interval of one row, that the lens sees."""
    figure, axes = canvas(6.4, 2.9)
    for line in np.arange(0.2, 6.3, 0.3):
        axes.plot((line, line), (0.2, 2.6), color="#e4e4e4", lw=0.6, zorder=0)
    for line in np.arange(0.2, 2.7, 0.3):
        axes.plot((0.2, 6.2), (line, line), color="#e4e4e4", lw=0.6, zorder=0)
    texels = (
        (2.6, 0.8),
        (2.6, 1.1),
        (2.9, 1.1),
        (3.2, 1.1),
        (2.9, 1.4),
        (3.2, 1.4),
        (3.5, 1.4),
        (3.8, 1.4),
        (3.2, 1.7),
        (3.5, 1.7),
    )
    for corner in texels:
        axes.add_patch(Rectangle(corner, 0.3, 0.3, facecolor="#ffd28a", edgecolor=ORANGE, lw=0.6))
    center = np.array([3.15, 1.35])
    axes.add_patch(Circle(tuple(center), 0.85, fill=False, edgecolor=GREY, lw=1.2, ls=(0, (4, 3))))
    axes.add_patch(Ellipse(tuple(center), 1.55, 1.15, facecolor="#2f6fb7", alpha=0.18))
    axes.add_patch(Ellipse(tuple(center), 1.55, 1.15, fill=False, edgecolor=BLUE, lw=1.6))
    y = 1.55
    half = 0.775 * np.sqrt(1.0 - ((y - center[1]) / 0.575) ** 2)
    axes.plot((center[0] - half, center[0] + half), (y, y), color=INK, lw=2.2)
    for top in (center[1] - 0.575, center[1] + 0.575):
        axes.plot((1.7, 4.6), (top, top), color=BLUE, lw=0.8, ls=(0, (3, 3)))
    arrow(axes, (1.75, center[1] - 0.575), (1.75, center[1] + 0.575), BLUE, "<|-|>")
    label(axes, 1.2, center[1], "row range", BLUE, fontsize=9)
    label(axes, 4.75, y, "row interval", INK, fontsize=9)
    arrow(axes, (4.32, y), (center[0] + half + 0.05, y))
    label(axes, 4.45, 0.62, "enclosing circle", GREY, fontsize=9)
    label(axes, 3.15, 2.45, "emitter's texels", ORANGE, fontsize=9)
    return figure


def epochs() -> plt.Figure:
    """Steps and the epochs of learning that they belong to."""
    figure, axes = canvas(8.0, 1.25)
    colors, width = (BLUE, ORANGE, GREEN, RED, "#7e57c2", "#00838f"), 0.235
    starts = [1, 2, 3, 5, 9, 17, 33]
    for number, (first, after) in enumerate(pairwise(starts)):
        for index in range(first, after):
            axes.add_patch(Rectangle((0.1 + (index - 1) * width, 0.45), width * 0.92, 0.35, facecolor=colors[number], alpha=0.75))
        middle = 0.1 + (0.5 * (first + after - 1) - 0.5) * width
        text = f"{first}" if after == first + 1 else f"{first} … {after - 1}"
        label(axes, middle, 0.28, text, colors[number], fontsize=9 if number > 2 else 8)
    label(axes, 4.0, 1.02, "steps of one epoch draw from one frozen state; learning happens at its end")
    return figure


def pixel_reuse() -> plt.Figure:
    """Two pixels see one point through two lens points."""
    figure, axes = canvas(8.0, 3.2)
    x, middle, radius = 0.7, 1.6, 1.2
    lens(axes, x, middle, radius)
    axes.plot((3.4, 3.4), (0.3, 2.9), color=GREY, lw=1.0)
    label(axes, 3.4, 3.08, "focal plane", GREY)
    point = np.array([7.0, 1.75])
    for focus_y, color, name in ((1.95, BLUE, "i"), (1.55, ORANGE, "k")):
        focus = np.array([3.4, focus_y])
        slope = (point[1] - focus[1]) / (point[0] - focus[0])
        start = focus[1] + slope * (x - focus[0])
        axes.plot((x, point[0]), (start, point[1]), color=color, lw=1.5)
        axes.plot(*focus, "o", color=color, ms=5)
        axes.plot(x, start, "o", color=color, ms=5)
        label(axes, x - 0.36, start, rf"$l_{name}$", color)
        label(axes, 3.4 + 0.3, focus_y + (0.24 if name == "i" else -0.24), rf"$x_{{F,{name}}}$", color)
    axes.plot((6.75, 7.35), (0.75, 2.75), color=INK, lw=2.0)
    axes.plot(*point, "o", color=GREEN, ms=7)
    label(axes, 7.3, 1.62, r"$x$", GREEN)
    for angle in (2.35, 2.9, 3.6):
        arrow(axes, tuple(point), (point[0] + 0.65 * np.cos(angle), point[1] + 0.65 * np.sin(angle)), GREEN)
    label(axes, 6.35, 0.4, "primary hit and the\nradiance found there", GREEN, fontsize=10)
    label(axes, x, 0.16, "lens", BLUE)
    return figure


def virtual_image() -> plt.Figure:
    """An emitter, a mirror, and the virtual image at which the lens looks."""
    figure, axes = canvas(8.0, 3.2)
    x, middle = 0.7, 1.0
    lens(axes, x, middle, 0.7)
    mirror = 4.6
    axes.plot((mirror, mirror), (0.2, 2.9), color=INK, lw=2.2)
    for y in np.arange(0.3, 2.9, 0.2):
        axes.plot((mirror, mirror + 0.14), (y, y + 0.14), color=GREY, lw=0.8)
    emitter, image = np.array([2.6, 2.5]), np.array([2 * mirror - 2.6, 2.5])
    for edge in (middle - 0.45, middle + 0.45):
        slope = (image[1] - edge) / (image[0] - x)
        on_mirror = edge + slope * (mirror - x)
        axes.plot((x, mirror), (edge, on_mirror), color=ORANGE, lw=1.2)
        axes.plot((mirror, emitter[0]), (on_mirror, emitter[1]), color=ORANGE, lw=1.2)
        axes.plot((mirror, image[0]), (on_mirror, image[1]), color=ORANGE, lw=1.0, ls=(0, (4, 3)))
    axes.add_patch(Circle(tuple(emitter), 0.13, facecolor="#ffd28a", edgecolor=ORANGE, lw=1.4))
    axes.add_patch(Circle(tuple(image), 0.13, facecolor="white", edgecolor=ORANGE, lw=1.4, ls="--"))
    label(axes, emitter[0] - 0.1, emitter[1] + 0.32, "emitter", ORANGE)
    label(axes, image[0], image[1] + 0.32, "virtual image", ORANGE)
    label(axes, mirror, 0.08, "mirror")
    label(axes, x, 0.1, "lens", BLUE)
    return figure


def box(axes: Axes, x: float, y: float, width: float, height: float, text: str, color: str = BLUE, size: float = 10) -> None:
    style = "round,pad=0,rounding_size=0.08"
    axes.add_patch(FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor="white", edgecolor=color, lw=1.4))
    label(axes, x + width / 2, y + height / 2, text, fontsize=size, linespacing=1.25)


def step() -> plt.Figure:
    """One step, which is one SPP."""
    figure, axes = canvas(8.0, 3.1)
    rows = (
        (("pixels", INK), ("focus points", INK), ("lens query", ORANGE), ("lens points", ORANGE), ("rays", INK)),
        (("paths", INK), ("reuse", GREEN), ("film", INK), ("record", ORANGE), ("update", ORANGE)),
    )
    width, gap = 1.36, 0.25
    for number, names in enumerate(rows):
        y = 2.05 - 1.15 * number
        for column, (name, color) in enumerate(names):
            x = 0.05 + column * (width + gap)
            box(axes, x, y, width, 0.55, name, color)
            if column < len(names) - 1:
                arrow(axes, (x + width, y + 0.275), (x + width + gap, y + 0.275))
    last = 0.05 + 4 * (width + gap) + width / 2
    axes.plot((last, last, 0.05 + width / 2), (2.05, 1.75, 1.75), color=INK, lw=1.4)
    arrow(axes, (0.05 + width / 2, 1.76), (0.05 + width / 2, 1.45))
    third = 0.05 + 2 * (width + gap) + width / 2
    axes.plot((last, last, third), (0.9, 0.35, 0.35), color=ORANGE, lw=1.2, ls=(0, (4, 3)))
    axes.plot((third, third), (0.35, 0.85), color=ORANGE, lw=0)
    label(axes, third - 0.1, 0.35, "the next step draws from the updated sampler", ORANGE, ha="right", fontsize=9)
    for x, color, name in ((0.05, ORANGE, "LensSampler"), (1.75, GREEN, "SampleReuse")):
        axes.plot((x, x + 0.25), (2.92, 2.92), color=color, lw=2)
        label(axes, x + 0.33, 2.92, name, color, ha="left", fontsize=9)
    label(axes, 3.45, 2.92, "LightStrategy: within “paths”", INK, ha="left", fontsize=9)
    return figure


def packages() -> plt.Figure:
    """Which package may import which."""
    figure, axes = canvas(8.0, 4.3)
    box(axes, 3.0, 3.65, 2.0, 0.5, "cli", INK)
    box(axes, 3.0, 2.85, 2.0, 0.5, "evaluation", INK)
    box(axes, 5.7, 2.85, 2.2, 0.5, "view", INK)
    box(axes, 0.1, 2.85, 2.2, 0.5, "mitsuba", INK)
    box(axes, 3.0, 2.05, 2.0, 0.5, "train", INK)
    box(axes, 1.0, 1.25, 2.6, 0.5, "guiding", ORANGE)
    box(axes, 4.4, 1.25, 2.6, 0.5, "baselines/restir", GREEN)
    box(axes, 0.1, 0.3, 2.2, 0.5, "models", ORANGE)
    box(axes, 2.9, 0.3, 2.2, 0.5, "render", BLUE)
    box(axes, 5.7, 0.3, 2.2, 0.5, "scene", BLUE)
    for start, end in (
        ((4.0, 3.65), (4.0, 3.35)),
        ((4.0, 2.85), (4.0, 2.55)),
        ((4.7, 3.65), (6.2, 3.35)),
        ((6.2, 2.85), (4.7, 2.55)),
        ((1.2, 2.85), (1.9, 1.75)),
        ((3.6, 2.05), (2.6, 1.75)),
        ((4.4, 2.05), (5.4, 1.75)),
        ((1.8, 1.25), (1.3, 0.8)),
        ((2.8, 1.25), (3.6, 0.8)),
        ((5.2, 1.25), (4.4, 0.8)),
        ((5.1, 0.55), (5.7, 0.55)),
        ((2.3, 0.55), (2.9, 0.55)),
    ):
        arrow(axes, start, end)
    label(axes, 4.0, 0.08, "runtime (device, threads, native core) and image serve all of them", GREY, fontsize=9)
    return figure


def densities() -> None:
    """Densities of three lens distributions for one highlight, per unit lens area."""
    radius, size = 1.0, 320
    axis = torch.linspace(-1.3, 1.3, size)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    points = torch.stack((x.flatten(), -y.flatten()))
    count = points.shape[1]
    focus = torch.tensor([[0.0], [0.0], [4.0]]).expand(3, count)
    # A ball of radius 0.13 at Z = 8: k = -1, so that the lens plane shows the ball at its own size.
    mean, ball = torch.tensor([[-0.55], [-0.62], [8.0]]).expand(3, count), 0.3
    gaussian = lens_density(points, focus, mean, torch.full((count,), ball / 1.78))
    inside = (points[0] ** 2 + points[1] ** 2 <= radius**2).float()
    center = -mean[:2, :1]
    ellipse = ((points - center).square().sum(0) <= ball**2).float() / (np.pi * ball**2)
    kept = ellipse * inside
    along = (points * center / center.norm()).sum(0)
    kept = ellipse * (along <= radius).float()
    uniform = inside / (np.pi * radius**2)
    titles = ("uniform", "projected Gaussian (lis)", "ellipse, clipped by the lens (guided)")
    figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.3), dpi=110)
    for plot, values, title in zip(axes, (uniform, gaussian, kept), titles):
        image = values.reshape(size, size)
        plot.imshow(image, extent=(-1.3, 1.3, -1.3, 1.3), cmap="inferno", norm=PowerNorm(0.5, 0.0, 4.0))
        plot.add_patch(Circle((0, 0), radius, fill=False, edgecolor="white", lw=1.0))
        plot.set(xticks=[], yticks=[], title=title)
        plot.title.set_fontsize(10)
    figure.tight_layout()
    path = IMAGES / "densities.png"
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
