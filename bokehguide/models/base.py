"""Distributions of lens points in the manner of torch.distributions: `sample`, `pdf` and `log_prob`.

One object holds the distributions of N pixels, one density q for each. Lens points are `[2, N]`, metres, in the camera frame.
Densities are per unit lens area (1/m²). The caller supplies uniform numbers and so controls their seeds and stratification.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.lens import Lens
from bokehguide.runtime.compile.kernels import kernel

WEIGHT_STEPS = 2.0**40
"""Mixture weights are whole multiples of 1 / WEIGHT_STEPS when a candidate is drawn. Sums of whole numbers are exact."""


class LensSample(NamedTuple):
    """One lens point for each of N pixels.

    points: `[2, N]`, metres; a point may lie outside the aperture. candidate: the candidate that each point was drawn from,
    int64 `[N]`, -1 for the uniform part; None if the distribution does not report candidates.
    """

    points: Tensor
    candidate: Tensor | None = None


class LensDensity(NamedTuple):
    """Densities of a mixture at one lens point for each of N pixels, 1/m².

    points: the lens points `[2, N]`; components: p_i of all candidates, `[M]`; mixture: p_GMM, `[N]`; density: q, `[N]`.
    """

    points: Tensor
    components: Tensor
    mixture: Tensor
    density: Tensor


class LensDistribution:
    """The densities q of N pixels on the lens plane.

    lens: the aperture. A subclass implements `sample` and `pdf`.
    """

    def __init__(self, lens: Lens):
        self.lens = lens

    def sample(self, uniforms: Tensor) -> LensSample:
        """One lens point for each pixel, from uniform numbers `[D, N]`. The subclass states D."""
        raise NotImplementedError

    def pdf(self, points: Tensor) -> Tensor:
        """q at one lens point `[2, N]` for each pixel, `[N]`."""
        raise NotImplementedError

    def log_prob(self, points: Tensor) -> Tensor:
        """Logarithm of `pdf`, `[N]`; -inf where q is 0."""
        return self.pdf(points).log()


class LensMixture(LensDistribution):
    """q = β Σ w_i p_i + (1 - β) W / A (Eq. 26), one mixture for each of N pixels.

    The M candidates of all pixels are packed: pixel i owns `start[i] : start[i + 1]`. A pixel without candidates has β = 0.
    A p_i may reach beyond the aperture; draws outside the aperture are samples of value 0.
    A subclass implements `sample` and `component_pdf`. Its constructor calls `_set_weights`.

    lens: the aperture. focus: x_F, `[3, N]`, metres. start: int64 `[N + 1]`. count: M.
    """

    guided: Tensor
    """Pixels with at least one candidate of positive weight, bool `[N]`."""
    beta: Tensor
    """β, `[N]`."""
    weight: Tensor
    """Mixture weights w_i, `[M]`. Their sum over the candidates of a guided pixel is 1."""

    def __init__(self, lens: Lens, focus: Tensor, start: Tensor, count: int):
        super().__init__(lens)
        self.focus, self._start = focus, start
        self.owner = owners(start, count)
        """Pixel that owns each candidate, int64 `[M]`."""

    def _set_weights(self, beta: Tensor, weight: Tensor) -> None:
        """Set β `[N]` and the mixture weights. weight: `[M]`, of any scale; 0 excludes a candidate."""
        total = torch.zeros(self.focus.shape[1], dtype=torch.float64, device=weight.device)
        total.index_add_(0, self.owner, weight.double())
        self.guided = total > 0.0
        self.beta = beta * self.guided
        self.weight, steps = _normalised(weight, total, self.owner)
        # Whole numbers have the same sums in every batch that a pixel may be in.
        cumulative = torch.zeros(len(steps) + 1, dtype=torch.int64, device=weight.device)
        torch.cumsum(steps, 0, out=cumulative[1:])
        self._ends = cumulative[1:]
        self._low, self._high = (cumulative.index_select(0, bound) for bound in (self._start[:-1], self._start[1:]))

    def choose(self, uniforms: Tensor) -> Tensor:
        """Draw a candidate for each pixel by weight, int64 `[N]`, from uniform numbers `[N]`.

        The result is an arbitrary valid index for a pixel that is not guided and for a number outside 0 … 1.
        """
        passed = _ends_before(self._ends, self._low, self._high, uniforms, self.owner)
        return self._start[:-1].clone().index_add_(0, self.owner, passed).clamp_(max=len(self.owner) - 1)

    def component_pdf(self, points: Tensor) -> Tensor:
        """p_i of all candidates, each at the lens point of its owner, `[M]`. points: `[2, N]`."""
        raise NotImplementedError

    def mixture_pdf(self, components: Tensor) -> Tensor:
        """p_GMM = Σ w_i p_i, `[N]`, from the result of `component_pdf`."""
        mixture = torch.zeros(self.focus.shape[1], device=components.device)
        return mixture.index_add_(0, self.owner, self.weight * components)

    def blend(self, points: Tensor, mixture: Tensor) -> Tensor:
        """q of Eq. 26, `[N]`, from p_GMM `[N]`."""
        return self.beta * mixture + (1.0 - self.beta) * self.lens.transmission(points) / self.lens.area

    def evaluate(self, points: Tensor) -> LensDensity:
        """All densities at one lens point for each pixel, `[2, N]`, anywhere on the lens plane."""
        components = self.component_pdf(points)
        mixture = self.mixture_pdf(components)
        return LensDensity(points, components, mixture, self.blend(points, mixture))

    def pdf(self, points: Tensor) -> Tensor:
        return self.evaluate(points).density


def owners(start: Tensor, count: int) -> Tensor:
    """Pixel that owns each candidate of a packed list, int64 `[M]`. start: int64 `[N + 1]`; count: M."""
    return torch.repeat_interleave(start[1:] - start[:-1], output_size=count)


@kernel
def _normalised(weight: Tensor, total: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """Weights `[M]` divided by their owners' totals `[N]`, float32, and the same in WEIGHT_STEPS, int64."""
    share = weight.double() / total.clamp(min=1e-300).index_select(0, owner)  # a total of 0 has weights of 0
    return share.float(), (share * WEIGHT_STEPS).long()


@kernel
def _ends_before(ends: Tensor, low: Tensor, high: Tensor, uniforms: Tensor, owner: Tensor) -> Tensor:
    """1 for each candidate before the drawn one of its owner, else 0, int64 `[M]`.

    ends: cumulative weights of the packed list, `[M]`; low, high: their values before and after each pixel, `[N]`.
    """
    target = low + ((high - low) * uniforms.double()).long()
    return (ends <= target.index_select(0, owner)).long()
