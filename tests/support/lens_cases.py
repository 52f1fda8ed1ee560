"""Lens densities for checks one by one: mixtures of one pixel, their draws, and polar quadrature.

Quadrature is in polar cells about the lens centre, so that the aperture's edge, where the
density jumps, falls between cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.models.base import LensMixture
from bokehguide.models.ellipse_mixture import EllipseMixture, EmitterShapes, balls, packed
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.native_mixture import CoreField, CoreGaussians, NativeEllipseMixture, NativeGaussianMixture
from bokehguide.render.lens import Lens
from tests.support.guides import mixture_of, pixel_batch
from tests.support.native_cases import core
from tests.support.statistical import chi_square

LENS = Lens(0.1, 2.0)
CHUNK = 1 << 17
INNER_RINGS = 8


Case = TypeVar("Case", bound="LensCase")


@dataclass(frozen=True)
class LensCase:
    """The mixture of one pixel: x_F `[3]`, β, and candidates mean `[3, M]`, sigma `[M]`, weight `[M]`.

    reach: the grid ends at this many lens radii; all draws beyond are one more cell. native: whether the native core holds the
    mixture.
    """

    name: str
    focus: tuple[float, float, float]
    beta: float
    mean: list[list[float]]
    sigma: list[float]
    weight: list[float]
    reach: float = 4.0
    lens: Lens = LENS
    native: bool = False

    def pixels(self, count: int) -> tuple[Lens, Tensor, Tensor, Tensor]:
        """Lens, focus points, β and starts of `count` pixels."""
        focus = torch.tensor(self.focus)[:, None].expand(3, count).contiguous()
        return self.lens, focus, torch.full((count,), self.beta), torch.arange(count + 1) * len(self.sigma)

    def distribution(self, count: int) -> LensMixture:
        """The same mixture for `count` pixels."""
        candidates = len(self.sigma)
        mean, sigma, weight = torch.tensor(self.mean).reshape(3, candidates), torch.tensor(self.sigma), torch.tensor(self.weight)
        if not self.native:
            return GaussianMixture(*self.pixels(count), mean.repeat(1, count), sigma.repeat(count), weight.repeat(count))
        field = GaussianField()
        field.assign(mean, sigma, sigma, weight)
        gaussians = CoreGaussians.of(core(), field, weight, None)
        return NativeGaussianMixture(
            *self.pixels(count), gaussians, torch.arange(candidates).repeat(count), torch.zeros(2, count)
        )

    def draw(self, count: int, seed: int) -> Tensor:
        """Lens points `[2, count]`, in chunks."""
        generator = torch.Generator().manual_seed(seed)
        drawn = []
        for _ in range(0, count, CHUNK):
            # The numbers of a render: multiples of 2^-23 shifted by half a step.
            bits = torch.randint(0, 1 << 23, (5, CHUNK), generator=generator)
            drawn.append(self.distribution(CHUNK).sample((bits + 0.5) / 2.0**23).points)
        return torch.cat(drawn, 1)[:, :count]

    def pdf(self, points: Tensor) -> Tensor:
        """q `[N]`, float64, at lens points `[2, N]`, in chunks."""
        parts = [self.distribution(part.shape[1]).pdf(part.float()) for part in points.split(CHUNK, 1)]
        return torch.cat(parts).double()


@dataclass(frozen=True)
class EllipseCase(LensCase):
    """A mixture of ellipses. sigma: radii of balls, unless axes gives half axes `[M, 3, 3]` of ellipsoids, one a row.

    learned_scale: factor of each candidate's weight; all 1 by default.
    """

    axes: tuple | None = None
    learned_scale: tuple[float, ...] = ()

    def shapes(self, count: int) -> EmitterShapes | None:
        """Candidates of `count` pixels with a shape other than an ellipsoid; None for none."""
        return None

    def outlines(self) -> torch.Tensor:
        if self.axes is None:
            return balls(torch.tensor(self.sigma))
        axes = torch.tensor(self.axes)
        return packed(axes.transpose(1, 2) @ axes)

    def distribution(self, count: int) -> EllipseMixture | NativeEllipseMixture:
        candidates, pixels = len(self.sigma), self.pixels(count)
        mean, weight = torch.tensor(self.mean).reshape(3, candidates), torch.tensor(self.weight)
        scale = torch.tensor(self.learned_scale or (1.0,) * candidates).repeat(count)
        if not self.native:
            field = (mean.repeat(1, count), self.outlines().repeat(1, count), weight.repeat(count))
            return EllipseMixture(*pixels, *field, scale, self.shapes(count))
        none = torch.full((candidates,), -1)
        shapes = self.shapes(1) or EmitterShapes(None, none, None, none, torch.zeros(0))
        field = CoreField.of(core(), mean, self.outlines(), weight, shapes)
        return NativeEllipseMixture(*pixels, field, torch.arange(candidates).repeat(count), scale)


def in_both_forms(cases: Sequence[Case]) -> list[Case]:
    """The cases in PyTorch and in the native core."""
    return [*cases, *(replace(case, name=f"{case.name}, native", native=True) for case in cases)]


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


def probabilities(case: LensCase, cells: PolarGrid) -> np.ndarray:
    """Integrals of the density over the cells by many nodes a cell, as the density jumps at the edge of every ellipse."""
    points, area = cells.nodes(60)
    return (case.pdf(points).numpy().reshape(area.shape) * area).sum(2)


def histogram_check(observed: np.ndarray, probability: np.ndarray) -> float:
    """p-value of the counts of a PolarGrid against the density's integrals over its cells."""
    return chi_square(observed, np.append(probability.ravel(), max(1.0 - probability.sum(), 0.0)))


def seen_by_pixel(guide: GaussianGuide, pixel: int) -> LensCase:
    """The mixture that `guide` draws from in one pixel, at the pixel's centre."""
    mixture, camera = mixture_of(guide, pixel_batch(guide, slice(pixel, pixel + 1))), guide.camera
    assert isinstance(mixture, GaussianMixture | NativeGaussianMixture)
    values = (mixture.mean.tolist(), mixture.sigma.tolist(), mixture.weight.tolist())
    return LensCase(f"pixel {pixel}", tuple(mixture.focus[:, 0].tolist()), float(mixture.beta), *values, lens=camera.lens)


X_F = (0.3, -0.2, 2.0)


def mean_through(x: float, y: float, z: float) -> list[list[float]]:
    """The mean `[3, 1]` whose projection through X_F is the lens point (x, y), at depth z."""
    k = X_F[2] / (X_F[2] - z)
    return [[X_F[0] + (x - X_F[0]) / k], [X_F[1] + (y - X_F[1]) / k], [z]]


def means_of(*means: list[list[float]]) -> list[list[float]]:
    """Means `[3, 1]` side by side, `[3, M]`."""
    return np.concatenate(means, 1).tolist()


CASES = [
    LensCase("before", X_F, 1.0, mean_through(0.02, 0.01, 1.2), [0.01], [1.0]),
    LensCase("behind", X_F, 1.0, mean_through(-0.03, 0.02, 6.0), [0.06], [1.0]),
    LensCase("almost in focus", X_F, 1.0, mean_through(0.0, 0.05, 2.002), [0.05], [1.0], reach=1000.0),
    LensCase("before the lens's rim", X_F, 1.0, mean_through(0.05, 0.05, 0.1), [0.02], [1.0]),
    LensCase("environment", X_F, 1.0, mean_through(0.03, 0.0, 2000.0), [40.0], [1.0]),
    LensCase("centre outside", X_F, 1.0, mean_through(0.13, -0.02, 5.0), [0.08], [1.0]),
    LensCase(
        "mixture",
        X_F,
        1.0,
        means_of(mean_through(0.03, 0.03, 1.3), mean_through(-0.06, 0.0, 5.0), mean_through(0.1, -0.05, 9.0)),
        [0.01, 0.04, 0.1],
        [3.0, 1.0, 0.5],
    ),
    LensCase(
        "one of two culled",
        X_F,
        1.0,
        means_of(mean_through(0.4, 0.0, 5.0), mean_through(0.0, 0.06, 5.0)),
        [0.03, 0.03],
        [5.0, 1.0],
    ),
    LensCase("blend", X_F, 0.6, means_of(mean_through(0.0, 0.07, 1.5), mean_through(-0.05, 0.0, 4.0)), [0.01, 0.03], [1.0, 1.0]),
    LensCase("all culled", X_F, 0.9, mean_through(0.5, 0.5, 6.0), [0.03], [1.0]),
    LensCase("a wide lens", (1.0, -0.5, 1.0), 0.8, [[2.0], [-1.4], [3.0]], [0.6], [1.0], reach=30.0, lens=Lens(0.5, 1.0)),
]
