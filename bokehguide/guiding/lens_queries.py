"""Lens queries: the uniform lens, and its mixtures with the components of a field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

from bokehguide.guiding.protocols import LensPoints, LensQuery
from bokehguide.models.base import LensMixture
from bokehguide.models.uniform import UniformLensDistribution
from bokehguide.render.lens import Lens

M = TypeVar("M", bound=LensMixture)


@dataclass(frozen=True)
class UniformQuery(LensQuery):
    """Lens points with the density W / A (Eq. 9), from uniform numbers `[2, N]`, for focus points `[3, N]`.

    A round aperture has the density 1 / A.
    """

    lens: Lens
    focus: Tensor
    uniforms: Tensor
    varies = False

    def sample(self) -> LensPoints:
        points = UniformLensDistribution(self.lens).sample(self.uniforms).points
        return LensPoints(points, self.lens.unblocked(points, self.focus))

    def pdf(self, points: Tensor) -> Tensor:
        return UniformLensDistribution(self.lens).pdf(points)


@dataclass(frozen=True)
class MixtureQuery(LensQuery, Generic[M]):
    """Lens points of a mixture (Eq. 26), from the uniform numbers that `mixture.sample` takes.

    A pixel without candidates gets the same bits as from `UniformQuery`.

    component: of the field, for each candidate, int64 `[M]`. slots: slot of each candidate's success rate, `[M]`, None if success
    rates are not learned.
    """

    mixture: M
    uniforms: Tensor
    component: Tensor
    slots: Tensor | None = None

    def sample(self) -> LensPoints:
        points, candidate = self.mixture.sample(self.uniforms)
        at = self.mixture.evaluate(points)
        return LensPoints(points, self.mixture.weights(at), at, candidate)

    def pdf(self, points: Tensor) -> Tensor:
        return self.mixture.pdf(points)

    def own_pdf(self, drawn: LensPoints) -> Tensor:
        assert drawn.at is not None
        return drawn.at.density
