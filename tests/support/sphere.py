"""Directions on the sphere for tests of scattering: quadratures, a histogram, and surfaces to scatter at."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from bokehguide.render.bsdf.opaque import OpaqueBSDF
from bokehguide.render.surface import MIN_ALPHA, Surface
from tests.support.scattering_formulas import ggx, smith_lambda
from tests.support.statistical import z_test


class SphereGrid:
    """`rows × columns` cells of equal angles about z, each with `fineness`² Gauss-Legendre points.

    directions: float32 `[3, N]`, the points; solid_angle: float64 `[N]`, what each stands for.
    """

    def __init__(self, rows: int = 32, columns: int = 64, fineness: int = 12):
        self.rows, self.columns, self._fineness = rows, columns, fineness
        nodes, weights = np.polynomial.legendre.leggauss(fineness)
        within = 0.5 * (nodes + 1.0)
        theta = ((np.arange(rows)[:, None] + within) * np.pi / rows).ravel()
        phi = ((np.arange(columns)[:, None] + within) * 2.0 * np.pi / columns).ravel() - np.pi
        theta_weight = np.tile(weights, rows) * 0.5 * np.pi / rows * np.sin(theta)
        phi_weight = np.tile(weights, columns) * np.pi / columns
        self.solid_angle = np.outer(theta_weight, phi_weight).ravel()
        theta, phi = np.meshgrid(theta, phi, indexing="ij")
        points = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))).reshape(3, -1)
        self.directions = torch.from_numpy(points.astype(np.float32))

    def integral(self, values: Tensor) -> np.ndarray:
        """Integral over the sphere of `values` `[..., N]` given at `directions`."""
        return values.double().numpy() @ self.solid_angle

    def cell_integrals(self, values: Tensor) -> np.ndarray:
        """Integrals of `values` `[N]` over the cells, `[rows * columns]`."""
        shape = (self.rows, self._fineness, self.columns, self._fineness)
        return (values.double().numpy() * self.solid_angle).reshape(shape).sum((1, 3)).ravel()

    def cells(self, directions: Tensor) -> np.ndarray:
        """The cell of each of `directions` `[3, M]`, integers `[M]`."""
        x, y, z = directions.double().numpy()
        row = np.arccos(np.clip(z, -1.0, 1.0)) / np.pi * self.rows
        column = (np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * self.columns
        return row.astype(int).clip(0, self.rows - 1) * self.columns + column.astype(int).clip(0, self.columns - 1)

    def histogram(self, directions: Tensor) -> np.ndarray:
        """How many of `directions` `[3, M]` fall into each cell, `[rows * columns]`."""
        return np.bincount(self.cells(directions), minlength=self.rows * self.columns)

    def albedo_check(self, at_points: OpaqueBSDF, of_draws: OpaqueBSDF, uniforms: Tensor) -> float:
        """p-value of the mean weight of draws from `uniforms` `[3, M]` being the albedo by quadrature. The arguments are the same
        BSDF, at the points of this grid and at M draws."""
        albedo = self.integral(at_points.evaluate(self.directions)[0])
        value, pdf = of_draws.evaluate(of_draws.sample(uniforms))
        weights = (value / pdf.clamp(min=1e-20)).double().numpy()
        error = weights.std(axis=1) / math.sqrt(weights.shape[1]) + 1e-3 * albedo  # the quadrature's own
        return z_test(weights.mean(axis=1) - albedo, error)


def even_square(log2_count: int, seed: int) -> np.ndarray:
    """2^log2_count points of the unit square, `[2, N]`: a scrambled Sobol' set."""
    return qmc.Sobol(2, seed=seed).random_base2(log2_count).T


def visible_normals(outgoing: np.ndarray, alpha: float, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half vectors for points of the unit `square` `[2, N]`, `[3, N]`, and their density `[N]`.

    float64, by the projected disc (Heitz 2018). outgoing: `[3, 1]`.
    """
    u, angle = square
    view = outgoing[:, 0] * np.array([alpha, alpha, 1.0])
    view /= np.linalg.norm(view)
    across = np.array([-view[1], view[0], 0.0]) if abs(view[2]) < 1.0 - 1e-12 else np.array([1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    x, y = np.sqrt(u) * np.cos(2.0 * np.pi * angle), np.sqrt(u) * np.sin(2.0 * np.pi * angle)
    up = 0.5 * (1.0 + view[2])
    y = (1.0 - up) * np.sqrt(1.0 - x * x) + up * y
    z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
    half = np.outer(across, x) + np.outer(np.cross(view, across), y) + np.outer(view, z)
    half *= np.array([alpha, alpha, 1.0])[:, None]
    half /= np.linalg.norm(half, axis=0)
    density = ggx(half, alpha) * (outgoing * half).sum(0) / (outgoing[2] * (1.0 + smith_lambda(outgoing, alpha)))
    return half, density


class LobeGrid:
    """A quadrature over the directions above a surface that crowds where its lobes are, however narrow.

    2^log2_count points for the cosine lobe and as many for each GGX α, joined by the balance
    heuristic. directions: float64 `[3, N]`; solid_angle: `[N]`, what each stands for.
    """

    def __init__(self, outgoing: np.ndarray, alphas: list[float], log2_count: int = 14, seed: int = 0):
        u, angle = even_square(log2_count, seed)
        around = 2.0 * np.pi * angle
        points = [np.stack((np.sqrt(u) * np.cos(around), np.sqrt(u) * np.sin(around), np.sqrt(1.0 - u)))]
        for alpha in alphas:
            half, _ = visible_normals(outgoing, alpha, np.stack((u, angle)))
            points.append(2.0 * (outgoing * half).sum(0) * half - outgoing)
        points = np.concatenate(points, axis=1)
        self.directions = points[:, points[2] > 1e-9]
        half = self.directions + outgoing
        half /= np.linalg.norm(half, axis=0)
        density = self.directions[2] / np.pi
        for alpha in alphas:
            density = density + ggx(half, alpha) / (4.0 * outgoing[2] * (1.0 + smith_lambda(outgoing, alpha)))
        self.solid_angle = 1.0 / (density * len(u))


def squeezed(directions: np.ndarray, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Half vectors `[3, N]` from `directions` in which every GGX is that of α = 1, and dω(half) / dω(direction) `[N]`."""
    half = directions * np.array([alpha, alpha, 1.0])[:, None]
    length = np.linalg.norm(half, axis=0)
    return half / length, alpha**2 / length**3


def unsqueezed(half: np.ndarray, alpha: float) -> np.ndarray:
    """The inverse of `squeezed`, `[3, N]`."""
    directions = half / np.array([alpha, alpha, 1.0])[:, None]
    return directions / np.linalg.norm(directions, axis=0)


def tilted(degrees: float, count: int) -> Tensor:
    """The direction at an angle to z, in a plane of no symmetry, `[3, count]`."""
    angle, azimuth = math.radians(degrees), 0.7
    x, y, z = math.sin(angle) * math.cos(azimuth), math.sin(angle) * math.sin(azimuth), math.cos(angle)
    return torch.tensor([x, y, z])[:, None].expand(3, count)


def surface(
    count: int,
    base_color=(0.8, 0.5, 0.3),
    metallic=0.0,
    roughness=0.5,
    specular=1.0,
    transmission=0.0,
    thin=0.0,
    ior=1.5,
    specular_color=None,
    clearcoat=None,
    clearcoat_roughness=0.0,
    clearcoat_normal=None,
    sheen_color=None,
    sheen_roughness=0.0,
    anisotropy=None,
    tangent=(1.0, 0.0, 0.0),
    diffuse_transmission=None,
    transmission_color=(1.0, 1.0, 1.0),
    iridescence=None,
    film_ior=1.3,
    film_thickness=400.0,
    dispersion=None,
    single_scattering=None,
    front=1.0,
    outgoing: Tensor | None = None,
    normal=(0.0, 0.0, 1.0),
    geometric_normal=(0.0, 0.0, 1.0),
) -> Surface:
    """`count` copies of a surface at the origin with these parameters."""

    alpha = max(roughness * roughness, MIN_ALPHA)

    def whole(value: float) -> Tensor:
        return torch.full((count,), float(value))

    def vector(value) -> Tensor:
        return torch.tensor(value, dtype=torch.float32)[:, None].expand(3, count)

    return Surface(
        position=vector((0.0, 0.0, 0.0)),
        outgoing=vector((0.0, 0.0, 1.0)) if outgoing is None else outgoing,
        geometric_normal=vector(geometric_normal),
        normal=vector(normal),
        front=whole(front),
        offset=whole(1e-5),
        facing=whole(1.0),
        base_color=vector(base_color),
        metallic=whole(metallic),
        alpha=whole(alpha),
        specular=whole(specular),
        transmission=whole(transmission),
        thin=whole(thin),
        ior=whole(ior),
        specular_color=None if specular_color is None else vector(specular_color),
        clearcoat=None if clearcoat is None else whole(clearcoat),
        clearcoat_alpha=None if clearcoat is None else whole(max(clearcoat_roughness**2, MIN_ALPHA)),
        clearcoat_normal=None if clearcoat_normal is None else vector(clearcoat_normal),
        sheen_color=None if sheen_color is None else vector(sheen_color),
        sheen_roughness=None if sheen_color is None else whole(sheen_roughness),
        tangent=None if anisotropy is None else vector(tangent),
        alpha_along=None if anisotropy is None else whole(alpha + (1.0 - alpha) * anisotropy**2),
        diffuse_transmission=None if diffuse_transmission is None else whole(diffuse_transmission),
        transmission_color=None if diffuse_transmission is None else vector(transmission_color),
        iridescence=None if iridescence is None else whole(iridescence),
        film_ior=None if iridescence is None else whole(film_ior),
        film_thickness=None if iridescence is None else whole(film_thickness),
        dispersion=None if dispersion is None else whole(dispersion),
        single_scattering=None if single_scattering is None else whole(single_scattering),
    )
