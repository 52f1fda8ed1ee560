"""Defensive pairwise MIS: how much each neighbour's sample counts beside the pixel's own.

Each neighbour is weighed against the centre alone, so that one pixel's weights cost as
many shifts as it has neighbours instead of their square (Bitterli 2022, in the defensive
form of Lin et al. 2022). Without reuse over time each sample stands for one: with M
neighbours the confidences are c = 1 and C = M + 1.

Arguments are `[N]`, a pair of pixels each. target: p̂ of the sample where it was drawn;
shifted: p̂ of what the shift makes of it in the other pixel; jacobian: of that shift;
count: M. The weights of all samples that a point can have come from sum to 1.
"""

from __future__ import annotations

from torch import Tensor

TINY = 1e-37
"""Keeps 0 / 0, of what is black in both pixels, from being NaN."""


def neighbour_weight(target: Tensor, shifted: Tensor, jacobian: Tensor, count: Tensor) -> Tensor:
    """m_i of a neighbour's sample, shifted to the centre."""
    neighbour = count * target  # in the measure of the neighbour: both sides times J
    return neighbour / (neighbour + shifted * jacobian).clamp(min=TINY) / (count + 1.0)


def centre_share(target: Tensor, shifted: Tensor, jacobian: Tensor, count: Tensor) -> Tensor:
    """What one neighbour adds to m_c, which without any is 1 / C, by the centre's sample, shifted there."""
    return target / (count * shifted * jacobian + target).clamp(min=TINY) / (count + 1.0)
