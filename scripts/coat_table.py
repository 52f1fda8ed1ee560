"""The tables of the albedos of microfacets, which the package loads.

    python scripts/coat_table.py

The integrals take a minute. Tables in files spare each render this minute.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.bsdf.brushed_albedo import (
    ALPHAS,
    BRUSHED_TABLE,
    COSINES,
    LENGTH,
    PLACES,
    STRENGTHS,
    BrushedAlbedo,
    brushed_table,
)
from bokehguide.render.bsdf.coat_albedo import COLUMNS, ROWS, TABLE, CoatAlbedo
from bokehguide.render.bsdf.microfacets import MIN_COSINE, Microfacets, sample_visible_normal
from bokehguide.render.surface import MIN_ALPHA
from bokehguide.render.vector import dot, fifth_power

EXCESS = 0.012
"""Share by which albedos of anisotropic microfacets in the table are too large: the error of the interpolation."""


def integrated_table(every: int = 1) -> Tensor:
    """S and B `[2, ROWS, WIDTH]` by Gauss-Legendre quadrature over the visible normals. every: spacing of the rows."""
    alpha = torch.linspace(MIN_ALPHA**0.125, 1.0, ROWS, dtype=torch.float64)[::every] ** 8
    cosine = (torch.linspace(0.0, 1.0, COLUMNS, dtype=torch.float64) ** 4).clamp(min=MIN_COSINE)
    outgoing = torch.stack(((1.0 - cosine.square()).sqrt(), torch.zeros_like(cosine), cosine))
    albedos = torch.stack([_albedos(outgoing, float(row), float(row), 0.5) for row in alpha], dim=1)
    means = (albedos * _mean_weights()).sum(-1, keepdim=True)
    return torch.cat((albedos, means), dim=-1).float()


def integrated_brushed_table(start: int = 0, every: int = 1) -> Tensor:
    """The table of `BrushedAlbedo` `[2, ALPHAS, STRENGTHS, LENGTH]` without means, from the table of isotropic microfacets.

    start, every: the first α and their spacing.
    """
    cosine, place = (x.flatten() for x in torch.meshgrid(_axis(COSINES) ** 4, _axis(PLACES), indexing="ij"))
    lowest = MIN_ALPHA**0.125
    table = torch.zeros(2, ALPHAS, STRENGTHS, LENGTH, dtype=torch.float64)
    for row in range(start, ALPHAS, every):
        alpha = float((lowest + (1.0 - lowest) * _axis(ALPHAS)[row]) ** 8)
        if row == ALPHAS - 1:  # both α are 1; the excess is for the interpolation between this row and the one before
            table[:, row, 1:, :-1] = EXCESS * _isotropic(torch.ones_like(cosine), cosine)[:, None]
            continue
        for column in range(1, STRENGTHS):
            along = alpha + (1.0 - alpha) * (column / (STRENGTHS - 1)) ** 2
            facing = (alpha**0.25 + (along**0.25 - alpha**0.25) * place) ** 4
            share = ((facing**2 - alpha**2) / (along**2 - alpha**2)).clamp(0.0, 1.0)  # cos² of the azimuth
            level = cosine.clamp(min=MIN_COSINE)
            sine = (1.0 - level.square()).sqrt()
            albedos = _albedos(torch.stack((sine * share.sqrt(), sine * (1.0 - share).sqrt(), level)), alpha, along, 1.0)
            table[:, row, column, :-1] = albedos * (1.0 + EXCESS) - _isotropic(facing, cosine)
    return table


def with_means(table: Tensor) -> Tensor:
    """The table with the differences of the means, by quadrature of the interpolated albedos."""
    (height, weight), azimuth = _nodes(48), math.pi / 2.0 * (torch.arange(48) + 0.5) / 48.0
    cosine = height.repeat_interleave(48).float()
    lowest = MIN_ALPHA**0.125
    for row in range(ALPHAS):
        alpha = (lowest + (1.0 - lowest) * _axis(ALPHAS)[row]).float() ** 8
        for column in range(1, STRENGTHS):
            along = alpha + (1.0 - alpha) * (column / (STRENGTHS - 1)) ** 2
            facing = ((along * azimuth.cos()).square() + (alpha * azimuth.sin()).square()).sqrt().repeat(48)
            brushed = BrushedAlbedo(alpha.expand(len(cosine)), along.expand(len(cosine)))
            albedos = torch.stack(brushed.towards(facing, cosine)) + _isotropic(facing, cosine)
            mean = (albedos * (2.0 * height * weight).repeat_interleave(48)).sum(1) / 48.0
            table[:, row, column, -1] = mean - _isotropic(along[None], None)[:, 0]
    return table


def _isotropic(alpha: Tensor, cosine: Tensor | None) -> Tensor:
    """S and B `[2, N]` of isotropic microfacets from the table, or their means."""
    alpha, one = alpha.float(), torch.ones(len(alpha))
    coats = [CoatAlbedo(Microfacets(one.expand(3, -1), alpha), *shares) for shares in ((one, 0.0 * one), (0.0 * one, one))]
    return torch.stack([coat.mean() if cosine is None else coat.towards(one, cosine.float()) for coat in coats])


def _albedos(outgoing: Tensor, alpha: float, along: float, turn: float) -> Tensor:
    """S and B `[2, N]` of microfacets of roughness `alpha` and `along`, seen from `outgoing` `[3, N]`.

    turn: part of the circle of half vectors, a half where both halves are alike.
    """
    (first, first_weight), (second, second_weight) = _nodes(round(64 * turn)), _nodes(64)
    uniforms = torch.stack((turn * first[:, None].expand(-1, 64), second.expand(len(first), -1))).flatten(1)
    weight, count = torch.outer(first_weight, second_weight).flatten(), outgoing.shape[1]
    outgoing = outgoing[:, :, None].expand(-1, -1, len(weight)).flatten(1)
    facets = Microfacets(outgoing, torch.full_like(outgoing[2], alpha), torch.full_like(outgoing[2], along))
    half = sample_visible_normal(outgoing, facets.alpha, uniforms.repeat(1, count), facets.along)
    towards = dot(outgoing, half)
    incoming = 2.0 * towards * half - outgoing
    visibility, density = facets.evaluate(half, incoming)
    masking = torch.where(incoming[2] > 0.0, visibility * incoming[2] / density, 0.0).unflatten(0, (count, -1)) * weight
    grazing = fifth_power((1.0 - towards).clamp(min=0.0)).unflatten(0, (count, -1))
    return torch.stack((masking.sum(1), (masking * grazing).sum(1)))


def _axis(size: int) -> Tensor:
    return torch.linspace(0.0, 1.0, size, dtype=torch.float64)


def _nodes(count: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights `[count]` on the interval from 0 to 1."""
    nodes, weights = map(torch.from_numpy, np.polynomial.legendre.leggauss(count))
    return 0.5 * (nodes + 1.0), 0.5 * weights


def _mean_weights() -> Tensor:
    """Weights `[COLUMNS]` of the columns in the mean ∫ 2 cos E d cos of the interpolated albedo; exact."""
    nodes, weights = _nodes(5)
    start = torch.arange(COLUMNS - 1, dtype=torch.float64)[:, None]
    density = 8.0 * ((start + nodes) / (COLUMNS - 1)) ** 7 * weights / (COLUMNS - 1)  # 2 cos d cos, in fourth roots
    total = torch.zeros(COLUMNS, dtype=torch.float64)
    total[:-1] += (density * (1.0 - nodes)).sum(1)
    total[1:] += (density * nodes).sum(1)
    return total


if __name__ == "__main__":
    np.save(TABLE, integrated_table().numpy())
    brushed = integrated_brushed_table()
    np.save(BRUSHED_TABLE, brushed.half().numpy())
    brushed_table.cache_clear()
    np.save(BRUSHED_TABLE, with_means(brushed).half().numpy())
