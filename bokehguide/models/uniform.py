"""The uniform distribution over the aperture (Eq. 9)."""

from __future__ import annotations

from torch import Tensor

from bokehguide.models.base import LensDistribution, LensSample


class UniformLensDistribution(LensDistribution):
    """q = W / A in every pixel, which is 1 / A on an even aperture. W is the transmission on the axis."""

    def sample(self, uniforms: Tensor) -> LensSample:
        """One lens point in the aperture for each pixel, from uniform numbers `[2, N]`."""
        return LensSample(self.lens.sample(uniforms))

    def pdf(self, points: Tensor) -> Tensor:
        """W / A at lens points `[2, N]`, 0 outside the aperture, `[N]`."""
        return self.lens.transmission(points) / self.lens.area
