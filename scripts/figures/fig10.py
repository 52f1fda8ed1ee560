"""Fig. 10: densities of the methods on the lens for one pixel, beside the radiance through the lens.

    python scripts/figures/fig10.py
    python scripts/figures/fig10.py chrome --pixel 40,35

The reference is the radiance through each cell of a 128 × 128 grid over the lens. The methods are histograms of 2^16 draws:
uniform; the chosen samples of Area ReSTIR, each from its own pass; draws of the guides of lis-o and guided after --spp steps.
Below each histogram stands KL(reference || method). One pseudo-count in every cell of the lens keeps it finite. Equally many
exact draws of the reference show the effect of the finite count and of the pseudo-counts. The default pixel is the brightest
one in the insets with two emitters on its lens. Writes fig10.png, fig10.md and fig10.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from common import figure_options, settings, sized, write_json, write_table
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from restir_pixel import PixelReuse
from torch import Tensor

from bokehguide.cli.scripts import run
from bokehguide.errors import BokehguideError
from bokehguide.evaluation import markdown, progress, regions
from bokehguide.evaluation.page import NORMAL, SMALL, WIDTH, save
from bokehguide.guiding.emitter_guide import EmitterGuide
from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.guiding.lens_queries import UniformQuery
from bokehguide.guiding.protocols import PixelBatch
from bokehguide.image import to_8_bit, tone_map
from bokehguide.models import BlendWeightMap
from bokehguide.models.base import owners
from bokehguide.models.candidates import CandidateList
from bokehguide.models.projection import project_to_lens
from bokehguide.render import dimensions
from bokehguide.render.lens import Lens
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene import Scene
from bokehguide.train import RenderLoop, RenderSettings

GRID, DRAWS, CELL_SAMPLES = 128, 1 << 16, 32
"""Cells across the lens; draws of a method; rays per cell of the reference."""
PASSES = 2048
"""Passes of Area ReSTIR at once."""
SEED = 7_000_000
"""Seed of all draws of this figure."""
WELL_ON = 0.8
"""Fraction of the lens's radius within which an emitter's centre is well within the lens."""
NAMES = {"area-restir": "Area ReSTIR", "exact": "exact draws of the reference"}


@dataclass
class Distributions:
    """Counts or radiance `[GRID, GRID]` by method for one pixel (column, row), with the top row of the lens first.

    inside: cells within the aperture; picture: radiance `[H, W, 3]`; outside: share of the draws that miss the lens.
    """

    scene: Scene
    pixel: tuple[int, int]
    picture: Tensor
    inside: Tensor
    grids: Mapping[str, Tensor]
    outside: Mapping[str, float]

    def divergence(self, name: str) -> float:
        """KL(reference || method) in nats."""
        expected = self.grids["reference"][self.inside].double()
        counts = self.grids[name][self.inside].double() + 1.0
        p, q = expected / expected.sum(), counts / counts.sum()
        return float((p * (p / q).log()).nan_to_num(0.0).sum())


def main() -> None:
    options = figure_options(__doc__, ["fairy-lights"], add_pixel)
    found = [distributions(sized(name, options), options) for name in options.scenes]
    write_figure(options.out / "fig10.png", found)
    write_json({one.scene.name: facts(one, options) for one in found}, options.out / "fig10.json")
    write_table([kl_table(one) for one in found], options.out / "fig10.json")
    print(f"wrote {options.out / 'fig10.png'} and .json")


def add_pixel(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--pixel", type=pixel, metavar="X,Y", help="column and row, from 0; default: one with two emitters on its lens"
    )


def pixel(text: str) -> tuple[int, int]:
    try:
        column, row = (int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no pixel; give column and row, such as 40,35") from None
    return column, row


def facts(found: Distributions, options: argparse.Namespace) -> dict[str, object]:
    """The numbers of the figure."""
    methods = [name for name in found.grids if name != "reference"]
    kl = {name: found.divergence(name) for name in methods}
    return {"pixel": found.pixel, "spp": options.spp, "draws": DRAWS, "kl": kl, "outside the lens": found.outside}


def kl_table(found: Distributions) -> str:
    """KL divergence and the share of draws outside the lens, by method."""
    rows = [[f"{found.scene.name}, pixel {found.pixel[0]}, {found.pixel[1]}", "KL, nats", "draws outside the lens"]]
    for name in (name for name in found.grids if name != "reference"):
        outside = f"{found.outside[name]:.2%}" if name in found.outside else ""
        rows.append([NAMES.get(name, name), f"{found.divergence(name):.3f}", outside])
    return markdown(rows)


def distributions(scene: Scene, options: argparse.Namespace) -> Distributions:
    """All distributions for the pixel of the options, or for a pixel with two emitters on its lens."""
    loops = {mode: trained(scene, mode, options) for mode in ("lis-o", "guided")}
    loop = loops["guided"]
    column, row = options.pixel or overlap(scene, loop)
    width, height = loop.camera.width, loop.camera.height
    if not (0 <= column < width and 0 <= row < height):
        raise BokehguideError(f"--pixel: {column},{row} is outside the frame; give 0,0 to {width - 1},{height - 1}")
    index, lens = row * width + column, loop.camera.lens
    radiance, inside = seen_through_lens(loop, index)
    points = {"uniform": uniform_points(loop, index), "area-restir": restir_points(loop, index, options)}
    points |= {mode: guided_points(one, index) for mode, one in loops.items()}
    outside = {name: 1.0 - float(lens.contains(one).float().mean()) for name, one in points.items()}
    grids = {name: histogram(lens, one) for name, one in points.items()}
    generator = torch.Generator().manual_seed(SEED)
    exact = torch.multinomial(radiance.flatten().double(), DRAWS, replacement=True, generator=generator)
    grids["exact"] = exact.bincount(minlength=GRID * GRID).reshape(GRID, GRID)
    return Distributions(scene, (column, row), loop.film.radiance(), inside, {"reference": radiance, **grids}, outside)


def trained(scene: Scene, mode: str, options: argparse.Namespace) -> RenderLoop:
    """A loop after all steps; its workers have ended."""
    with progress(f"{scene.name} {mode}", options.spp) as bar, RenderLoop(scene, settings(mode, options)) as loop:
        for _ in range(options.spp):
            loop.step()
            bar.update()
        return loop


def overlap(scene: Scene, loop: RenderLoop) -> tuple[int, int]:
    """Column and row of the brightest pixel in the insets with two of the scene's emitters well within its lens."""
    camera = loop.camera
    guide = RenderLoop(scene, RenderSettings("guided"), tracer=loop.tracer).mode.lens
    if guide.candidates is None:
        raise BokehguideError(f"{scene.name}: has no emitters out of focus; choose a pixel with --pixel X,Y")
    pixels = torch.arange(camera.width * camera.height)
    start, emitter = guide.candidates.batch(slice(0, len(pixels)))
    owner = owners(start, int(start[-1]))
    focus = camera.focus_points(torch.stack((pixels % camera.width, pixels // camera.width)) + 0.5)
    on_lens = project_to_lens(guide.field.mean[:, emitter], focus[:, owner])
    near = on_lens.square().sum(0) < (WELL_ON * camera.lens.radius) ** 2
    count = torch.zeros(len(pixels)).index_add_(0, owner, near.float())
    masks = regions(scene)
    shown = (count >= count.max().clamp(max=2.0)) & masks.get("insets", masks["frame"]).flatten()
    light = luminance(loop.film.radiance().permute(2, 0, 1).flatten(1))
    index = int(torch.where(shown, light, -1.0).argmax())
    return index % camera.width, index // camera.width


def focus_points(loop: RenderLoop, index: int, random: PixelRandom) -> tuple[Tensor, Tensor]:
    """Raster positions `[2, N]` spread over a pixel, and their focus points `[3, N]`."""
    corner = torch.tensor([[index % loop.camera.width], [index // loop.camera.width]])
    raster = corner + random.stratified(0, 2)
    return raster, loop.camera.focus_points(raster)


@torch.no_grad()
def seen_through_lens(loop: RenderLoop, index: int) -> tuple[Tensor, Tensor]:
    """Luminance of a pixel through each cell of the lens, and the cells within the aperture, `[GRID, GRID]`."""
    cells = torch.arange(GRID * GRID)
    light, passed = torch.zeros(2, GRID * GRID)
    lens = loop.camera.lens
    for step in range(1, CELL_SAMPLES + 1):
        random = PixelRandom(SEED, step, cells)
        _, focus = focus_points(loop, index, random)
        place = (torch.stack((cells % GRID, cells // GRID)) + random.stratified(dimensions.LENS, 2)) / (0.5 * GRID) - 1.0
        points = place * torch.tensor([[lens.radius], [-lens.radius]])
        passes = lens.transmission(points) * lens.unblocked(points, focus)
        traced = loop.tracer.trace(*loop.camera.rays(focus, points), random, PhaseTimer())
        light += luminance(traced.radiance) * passes
        passed += passes
    return light.reshape(GRID, GRID), (passed > 0.0).reshape(GRID, GRID)


def uniform_points(loop: RenderLoop, index: int) -> Tensor:
    """Draws `[2, DRAWS]` of the uniform lens."""
    random = PixelRandom(SEED, 1, torch.arange(DRAWS))
    focus = focus_points(loop, index, random)[1]
    return UniformQuery(loop.camera.lens, focus, random.stratified(dimensions.LENS, 2)).sample().points


@torch.no_grad()
def restir_points(loop: RenderLoop, index: int, options: argparse.Namespace) -> Tensor:
    """Lens points `[2, M]` chosen by Area ReSTIR in DRAWS passes, of the passes that found light."""
    radius = settings("area-restir", options).reuse_radius
    steps = range(1, DRAWS // PASSES + 1)
    return torch.cat([PixelReuse(loop, index, radius, SEED, step, PASSES).chosen() for step in steps], dim=1)


@torch.no_grad()
def guided_points(loop: RenderLoop, index: int) -> Tensor:
    """Draws `[2, DRAWS]` of a guide for one pixel, each for a film position of its own."""
    concentrate(loop.mode.lens, index, DRAWS)
    step = loop.step_number + 1
    random = PixelRandom(SEED, step, torch.arange(DRAWS))
    raster, focus = focus_points(loop, index, random)
    places = slice(0, DRAWS)
    return loop.mode.lens.query(PixelBatch(step, places, places, raster, raster % 1.0, focus, random, 1.0)).sample().points


def concentrate(guide: GaussianGuide | EmitterGuide, index: int, count: int) -> None:
    """Make a guide one of `count` pixels, each like the pixel at `index`."""
    if guide.candidates is not None:
        _, found = guide.candidates.batch(slice(index, index + 1))
        guide.candidates = CandidateList(torch.arange(count + 1) * len(found), found.repeat(count))
    if isinstance(guide, EmitterGuide):
        guide.beta = guide.beta[index].repeat(count)
    else:
        logit = guide.blend.logit[index].item()
        guide.blend = BlendWeightMap(count)
        torch.nn.init.constant_(guide.blend.logit, logit)
        guide.uniform = torch.zeros(count, dtype=torch.bool)


def histogram(lens: Lens, points: Tensor) -> Tensor:
    """Number of lens points `[2, N]` in each cell of the grid."""
    points = points[:, lens.contains(points)] / lens.radius
    column, row = ((points * torch.tensor([[1.0], [-1.0]]) + 1.0) * (0.5 * GRID)).long().clamp(0, GRID - 1)
    return (row * GRID + column).bincount(minlength=GRID * GRID).reshape(GRID, GRID)


def write_figure(path: Path, found: Sequence[Distributions]) -> None:
    """Write a row for each scene: the render with the pixel marked, and the distributions."""
    names = [name for name in found[0].grids if name != "exact"]
    figure = Figure((WIDTH, 1.3 * len(found) + 0.05), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01)
    axes = figure.subplots(len(found), 1 + len(names), squeeze=False, width_ratios=[1.6, *[1.0] * len(names)])
    for row, one in zip(axes, found):
        draw_picture(row[0], one)
        for axis, name in zip(row[1:], names):
            shown = draw_lens(axis, one, name)
            axis.set_title(NAMES.get(name, name), fontsize=NORMAL, pad=3)
        bar = figure.colorbar(shown, ax=list(row), fraction=0.012, pad=0.005)
        bar.ax.tick_params(labelsize=SMALL)
        bar.set_label("density / uniform", fontsize=SMALL)
    save(figure, path)


def draw_picture(axes: Axes, found: Distributions) -> None:
    """Draw the render and a box around the pixel."""
    axes.imshow(to_8_bit(tone_map(found.picture)), interpolation="nearest")
    reach = 0.02 * found.picture.shape[1]
    corner = (found.pixel[0] - reach, found.pixel[1] - reach)
    axes.add_patch(Rectangle(corner, 2 * reach, 2 * reach, fill=False, edgecolor="#ff2d55", linewidth=1.0))
    axes.set(xticks=[], yticks=[])
    axes.set_title(f"{found.scene.name}, pixel {found.pixel[0]}, {found.pixel[1]}", fontsize=NORMAL, pad=3)


def draw_lens(axes: Axes, found: Distributions, name: str) -> AxesImage:
    """Draw a density over the lens relative to the uniform density on a logarithmic scale; returns the drawn image."""
    grid = found.grids[name].float()
    density = grid * (found.inside.sum() / grid.sum())
    shown = torch.where(found.inside, density.clamp(min=0.1), torch.nan).numpy()
    drawn = axes.imshow(shown, norm=LogNorm(0.1, 200.0), cmap="magma", interpolation="nearest")
    axes.axis("off")
    label = "radiance" if name == "reference" else f"KL {found.divergence(name):.3f}"
    axes.text(0.5, -0.03, label, transform=axes.transAxes, fontsize=SMALL, ha="center", va="top")
    return drawn


if __name__ == "__main__":
    run(main, "finished renders are kept, and the same command continues")
