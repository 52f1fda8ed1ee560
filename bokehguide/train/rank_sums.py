"""Sums over the samples of all ranks."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bokehguide.train.ranks import Ranks


class RankSums(nn.Module):
    """Sums that samples are added to, each by the rank that rendered it.

    sums: of all ranks up to the last `merge`, a buffer; mine: what this rank is to add to.
    """

    def __init__(self, sums: Tensor, ranks: Ranks | None = None):
        super().__init__()
        self.ranks = ranks or Ranks()
        self.register_buffer("sums", sums)
        self.register_buffer("_own", None if self.ranks.alone else torch.zeros_like(sums), persistent=False)

    @property
    def mine(self) -> Tensor:
        return self.sums if self._own is None else self._own

    def merge(self) -> None:
        """Let every rank know the samples of all; collective."""
        if self._own is not None:
            self.sums += self.ranks.total(self._own)
            self._own.zero_()

    def _load_from_state_dict(self, state_dict, prefix, *args):
        """What was added since the last `merge` is no part of what is loaded."""
        super()._load_from_state_dict(state_dict, prefix, *args)
        if self._own is not None:
            self._own.zero_()
