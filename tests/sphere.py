"""Directions on the sphere for tests of scattering: a quadrature, a histogram, and surfaces to scatter at."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.geometry import MIN_ALPHA, Surface


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
    front=1.0,
    outgoing: Tensor | None = None,
    normal=(0.0, 0.0, 1.0),
    geometric_normal=(0.0, 0.0, 1.0),
) -> Surface:
    """`count` copies of a surface at the origin with these parameters."""

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
        base_color=vector(base_color),
        metallic=whole(metallic),
        alpha=whole(max(roughness * roughness, MIN_ALPHA)),
        specular=whole(specular),
        transmission=whole(transmission),
        thin=whole(thin),
        ior=whole(ior),
    )
