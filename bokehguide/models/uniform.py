"""The uniform distribution over the aperture (Eq. 9)."""

from __future__ import annotations

from torch import Tensor

from bokehguide.models.base import LensDistribution, LensSample


class UniformLensDistribution(LensDistribution):
    """q = W / A in every pixel. W is the transmission of the aperture on the axis, and A is the area of the aperture."""

    def sample(self, uniforms: Tensor) -> LensSample:
        """One lens point in the aperture for each pixel, from uniform numbers `[2, N]`."""
        return LensSample(self.lens.sample(uniforms))

    def pdf(self, points: Tensor) -> Tensor:
        """W / A at lens points `[2, N]`, 0 outside the aperture, `[N]`."""
        return self.lens.transmission(points) / self.lens.area
