"""The uniform lens."""

from __future__ import annotations

from bokehguide.guiding.lens_queries import UniformQuery
from bokehguide.guiding.protocols import LensSampler, PixelBatch
from bokehguide.render import dimensions


class UniformLens(LensSampler):
    """Lens points with the density W / A, independent from step to step as in the paper's comparisons."""

    weighted = False

    def query(self, batch: PixelBatch) -> UniformQuery:
        return UniformQuery(self.camera.lens, batch.focus, batch.random.uniform(dimensions.LENS, 2))
