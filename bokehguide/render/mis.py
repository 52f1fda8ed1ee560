"""Multiple importance sampling."""

from __future__ import annotations

from torch import Tensor


def power_heuristic(pdf: Tensor, other: Tensor) -> Tensor:
    """MIS weight of a sample of density `pdf` beside a technique of density `other` (Veach 1997)."""
    return 1.0 / (1.0 + (other / pdf.clamp(min=1e-30)).square())
