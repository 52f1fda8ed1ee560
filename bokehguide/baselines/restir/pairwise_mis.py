"""Defensive pairwise MIS: the weights of a pixel's own sample and of its neighbours' samples.

Each neighbour is compared with the centre only, so the number of shifts grows linearly with the number M of neighbours (Bitterli
2022; defensive form of Lin et al. 2022). Without temporal reuse, the confidence of each sample is c = 1, and C = M + 1.
The weights of all samples that may lead to one point sum to 1.

Arguments are `[N]`, one element for each pair of pixels. target: p̂ of the sample in its own pixel; shifted: p̂ of the shifted
sample in the other pixel; jacobian: of the shift; count: M.
"""

from __future__ import annotations

from torch import Tensor

TINY = 1e-37
"""Least divisor, for samples that are black in both pixels."""


def neighbour_weight(target: Tensor, shifted: Tensor, jacobian: Tensor, count: Tensor) -> Tensor:
    """m_i of a neighbour's sample, shifted to the centre."""
    neighbour = count * target  # in the neighbour's measure: numerator and denominator times J
    return neighbour / (neighbour + shifted * jacobian).clamp(min=TINY) / (count + 1.0)


def centre_share(target: Tensor, shifted: Tensor, jacobian: Tensor, count: Tensor) -> Tensor:
    """The term of one neighbour in m_c, from the centre's sample shifted to the neighbour. Without neighbours m_c is 1 / C."""
    return target / (count * shifted * jacobian + target).clamp(min=TINY) / (count + 1.0)
