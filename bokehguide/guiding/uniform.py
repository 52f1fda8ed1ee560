"""The uniform lens."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.guiding.lens_queries import UniformQuery
from bokehguide.guiding.protocols import LensContext, LensSampler, PixelBatch
from bokehguide.render import dimensions
from bokehguide.render.splitting import UNSPLIT, SplitPaths, Splitting


class UniformLens(LensSampler):
    """Lens points with the density W / A, independent from step to step as in the paper's comparisons.

    paths: number of paths of each sample, which split at the primary hit.
    """

    weighted = False

    def __init__(self, context: LensContext, paths: int = 1):
        super().__init__(context)
        self.paths_per_sample = paths

    def splitting(self, weight: Tensor) -> Splitting:
        count = self.paths_per_sample
        return UNSPLIT if count == 1 else SplitPaths(torch.full_like(weight, float(count)))

    def query(self, batch: PixelBatch) -> UniformQuery:
        return UniformQuery(self.camera.lens, batch.focus, batch.random.uniform(dimensions.LENS, 2))
