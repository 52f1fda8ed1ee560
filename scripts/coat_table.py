"""The table of the albedos of dielectric coats, which the package loads.

    python scripts/coat_table.py

The integrals take a second. A table in a file spares each render this second.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.bsdf.coat_albedo import COLUMNS, ROWS, TABLE
from bokehguide.render.bsdf.microfacets import MIN_COSINE, sample_visible_normal, smith_root
from bokehguide.render.geometry import MIN_ALPHA
from bokehguide.render.vector import dot, fifth_power


def integrated_table() -> Tensor:
    """S and B `[2, ROWS, WIDTH]` by Gauss-Legendre quadrature over the visible normals."""
    alpha = torch.linspace(MIN_ALPHA**0.125, 1.0, ROWS, dtype=torch.float64) ** 8
    cosine = (torch.linspace(0.0, 1.0, COLUMNS, dtype=torch.float64) ** 4).clamp(min=MIN_COSINE)
    albedos = torch.stack([_albedos(cosine, float(row)) for row in alpha], dim=1)
    means = (albedos * _mean_weights()).sum(-1, keepdim=True)
    return torch.cat((albedos, means), dim=-1).float()


def _albedos(cosine: Tensor, alpha: float) -> Tensor:
    """S and B `[2, N]` of microfacets of roughness `alpha`, at cosines `[N]`."""
    (first, first_weight), (second, second_weight) = _nodes(16), _nodes(32)
    uniforms = torch.stack((0.5 * first[:, None].expand(-1, 32), second.expand(16, -1))).flatten(1)  # half a turn
    weight = torch.outer(first_weight, second_weight).flatten()
    outgoing = torch.stack(((1.0 - cosine.square()).sqrt(), torch.zeros_like(cosine), cosine))
    outgoing = outgoing[:, :, None].expand(-1, -1, len(weight)).flatten(1)
    width = torch.full_like(outgoing[2], alpha)
    half = sample_visible_normal(outgoing, width, uniforms.repeat(1, len(cosine)))
    towards = dot(outgoing, half)
    incoming = 2.0 * towards * half[2] - outgoing[2]
    light, squared = incoming.clamp(min=1e-12), width.square()
    root, other = smith_root(outgoing[2], squared), smith_root(light, squared)
    masking = light * (outgoing[2] + root) / (outgoing[2] * other + light * root)  # G₂ / G₁(outgoing)
    masking = torch.where(incoming > 0.0, masking, 0.0).unflatten(0, (len(cosine), -1)) * weight
    grazing = fifth_power((1.0 - towards).clamp(min=0.0)).unflatten(0, (len(cosine), -1))
    return torch.stack((masking.sum(1), (masking * grazing).sum(1)))


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
