"""Defensive pairwise MIS: the weights of a pixel's own sample and of its neighbours' samples.

The weight of a neighbour depends on the neighbour and the centre pixel only, so that the number of shifts grows linearly with the
number M of neighbours (Bitterli 2022; defensive form of Lin et al. 2022). Without temporal reuse, the confidence of each sample
is c = 1, and C = M + 1. The weights of all samples that can lead to the same point sum to 1.

Arguments are `[N]`, one element for each pair of pixels. target: p̂ of the sample in its own pixel. shifted: p̂ of the shifted
sample in the other pixel. jacobian: of the shift. count: M.
"""

from __future__ import annotations

from torch import Tensor

TINY = 1e-37
"""Least divisor, for samples that are black in both pixels."""


def neighbour_weight(target: Tensor, shifted: Tensor, jacobian: Tensor, count: Tensor) -> Tensor:
    """Weight m_i of a neighbour's sample that is shifted to the centre pixel."""
    neighbour = count * target  # in the neighbour's measure: numerator and denominator times J
    return neighbour / (neighbour + shifted * jacobian).clamp(min=TINY) / (count + 1.0)


def centre_share(target: Tensor, shifted: Tensor, jacobian: Tensor, count: Tensor) -> Tensor:
    """The summand of one neighbour in m_c, the weight of the centre pixel's own sample. The other summand of m_c is 1 / C."""
    return target / (count * shifted * jacobian + target).clamp(min=TINY) / (count + 1.0)
