"""Lens densities that are checked one by one: a pixel's mixture, many draws from it, polar quadrature.

Quadrature is in polar cells about the lens centre, so that the aperture's edge, where the
density jumps, falls between cells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from statistical import chi_square
from torch import Tensor

from bokehguide.models.lens_distribution import GuidedLensDistribution, LensMixture
from bokehguide.render.lens import Lens
from bokehguide.train.guide import LensGuide

LENS = Lens(0.1, 2.0)
CHUNK = 1 << 17
INNER_RINGS = 8


@dataclass(frozen=True)
class LensCase:
    """The mixture of one pixel: x_F `[3]`, β, and candidates mean `[3, M]`, sigma `[M]`, weight `[M]`.

    reach: the grid ends at this many lens radii; what is drawn beyond is one more cell.
    """

    name: str
    focus: tuple[float, float, float]
    beta: float
    mean: list[list[float]]
    sigma: list[float]
    weight: list[float]
    reach: float = 4.0
    lens: Lens = LENS

    kind: ClassVar[type[LensMixture]] = GuidedLensDistribution

    def distribution(self, count: int) -> LensMixture:
        """The same mixture for `count` pixels."""
        candidates = len(self.sigma)
        return self.kind(
            self.lens,
            torch.tensor(self.focus)[:, None].expand(3, count).contiguous(),
            torch.full((count,), self.beta),
            torch.arange(count + 1) * candidates,
            torch.tensor(self.mean).reshape(3, candidates).repeat(1, count),
            torch.tensor(self.sigma).repeat(count),
            torch.tensor(self.weight).repeat(count),
        )

    def draw(self, count: int, seed: int) -> Tensor:
        """Lens points `[2, count]`, in chunks."""
        generator = torch.Generator().manual_seed(seed)
        drawn = []
        for _ in range(0, count, CHUNK):
            # The numbers of a render: multiples of 2^-23 shifted by half a step.
            bits = torch.randint(0, 1 << 23, (5, CHUNK), generator=generator)
            drawn.append(self.distribution(CHUNK).sample((bits + 0.5) / 2.0**23))
        return torch.cat(drawn, 1)[:, :count]

    def pdf(self, points: Tensor) -> Tensor:
        """q `[N]`, float64, at lens points `[2, N]`, in chunks."""
        parts = [self.distribution(part.shape[1]).pdf(part.float()) for part in points.split(CHUNK, 1)]
        return torch.cat(parts).double()


@dataclass(frozen=True)
class PolarGrid:
    """Cells between radii `edges` `[R + 1]` (metres) and `sectors` equal angles about `centre`."""

    edges: np.ndarray
    sectors: int = 24
    centre: tuple[float, float] = (0.0, 0.0)

    def count(self, points: Tensor) -> np.ndarray:
        """Points in each cell, and at the end those beyond the grid: `[R · sectors + 1]`."""
        x, y = (points.double().numpy().T - self.centre).T
        ring = np.searchsorted(self.edges, np.hypot(x, y), side="right") - 1
        sector = np.floor(np.mod(np.arctan2(y, x), 2.0 * np.pi) / (2.0 * np.pi) * self.sectors).astype(int) % self.sectors
        rings = len(self.edges) - 1
        cell = np.where(ring < rings, ring * self.sectors + sector, rings * self.sectors)
        return np.bincount(cell, minlength=rings * self.sectors + 1)

    def nodes(self, order: int = 10) -> tuple[Tensor, np.ndarray]:
        """Gauss-Legendre nodes `[2, N]` of all cells and the area each stands for, `[R, sectors, N / cells]`."""
        nodes, weights = np.polynomial.legendre.leggauss(order)
        nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
        low, width = self.edges[:-1, None], np.diff(self.edges)[:, None]
        radius = low + width * nodes  # [R, n]
        step = 2.0 * np.pi / self.sectors
        angle = (np.arange(self.sectors)[:, None] + nodes) * step  # [S, n]
        x = self.centre[0] + radius[:, None, :, None] * np.cos(angle)[None, :, None, :]
        y = self.centre[1] + radius[:, None, :, None] * np.sin(angle)[None, :, None, :]
        area = (width * radius * weights)[:, None, :, None] * (step * weights)[None, None, None]
        area = np.broadcast_to(area, x.shape).reshape(len(low), self.sectors, -1)
        return torch.from_numpy(np.stack((x.ravel(), y.ravel()))), area

    def integrate(self, function: Callable[[Tensor], Tensor]) -> np.ndarray:
        """Integrals of a function of lens points `[2, N]` over the cells, `[R, sectors]`."""
        points, area = self.nodes()
        return (function(points).double().numpy().reshape(area.shape) * area).sum(2)


def grid(case: LensCase) -> PolarGrid:
    """Rings of equal area inside the aperture and of growing width beyond it."""
    radius = case.lens.radius
    inner = radius * np.sqrt(np.arange(INNER_RINGS + 1) / INNER_RINGS)
    return PolarGrid(np.append(inner, radius * np.geomspace(1.0, case.reach, 15)[1:]))


def plane(scale: float, centre: tuple[float, float], rings: int = 60, sectors: int = 24) -> PolarGrid:
    """A grid of the whole plane but its far rim, finest within `scale` of `centre`."""
    t = np.linspace(0.0, 1.0, rings + 1)[:-1]
    return PolarGrid(np.append(scale * t / (1.0 - t), scale * np.geomspace(rings, 1e6, 40)[1:]), sectors, centre)


def histogram_check(observed: np.ndarray, probability: np.ndarray) -> float:
    """p-value of the counts of a PolarGrid against the density's integrals over its cells."""
    return chi_square(observed, np.append(probability.ravel(), max(1.0 - probability.sum(), 0.0)))


def seen_by_pixel(guide: LensGuide, pixel: int) -> LensCase:
    """What `guide` draws from in one pixel, at the pixel's centre."""
    camera = guide.camera
    raster = torch.tensor([[pixel % camera.width + 0.5], [pixel // camera.width + 0.5]])
    mixture = guide.distribution(slice(pixel, pixel + 1), raster, camera.focus_points(raster)).distribution
    values = (mixture.mean.tolist(), mixture.sigma.tolist(), mixture.weight.tolist())
    return LensCase(f"pixel {pixel}", tuple(mixture.focus[:, 0].tolist()), float(mixture.beta), *values, lens=camera.lens)
