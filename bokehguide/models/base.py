"""Distributions of lens points, with the methods `sample`, `pdf` and `log_prob` as in torch.distributions.

One object holds the distributions of N pixels: a density q for each pixel. Lens points are `[2, N]`, metres, in the camera frame.
Densities are per unit lens area (1/m²). The caller supplies the uniform numbers, and so controls their seeds and stratification.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from bokehguide.render.lens import Lens

WEIGHT_STEPS = 2.0**40
"""For the draw of a candidate, mixture weights are rounded to multiples of 1 / WEIGHT_STEPS: sums of whole numbers are exact."""


class LensSample(NamedTuple):
    """One lens point for each of N pixels.

    points: `[2, N]`, metres. A point may lie outside the aperture. candidate: candidate from which the point was drawn, int64
    `[N]`, -1 for the uniform part; None if the distribution does not report candidates.
    """

    points: Tensor
    candidate: Tensor | None = None


class LensDensity(NamedTuple):
    """Densities of a mixture at one lens point for each of N pixels, 1/m².

    points: lens points, `[2, N]`. components: densities p_i of all M candidates, `[M]`. mixture: p_GMM = Σ w_i p_i, `[N]`.
    density: q, `[N]`.
    """

    points: Tensor
    components: Tensor
    mixture: Tensor
    density: Tensor


class LensDistribution:
    """Base class of distributions on the lens plane, with a density q for each of N pixels.

    A subclass implements `sample` and `pdf`. lens: the aperture.
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

    w_i is the weight and p_i the density of candidate i. β is the weight of all candidates. W is the transmission and A the area
    of the aperture. Pixel i owns the candidates `start[i] : start[i + 1]` of the M candidates of all pixels. A pixel without
    candidates has β = 0. A density p_i may extend beyond the aperture: lens points outside the aperture are samples of value 0.
    A subclass implements `sample` and `component_pdf`. The constructor of a subclass calls `_set_weights`.

    lens: the aperture. focus: focus points x_F, `[3, N]`, metres. start: int64 `[N + 1]`. count: M.
    """

    guided: Tensor
    """Pixels with at least one candidate of positive weight, bool `[N]`."""
    beta: Tensor
    """β, `[N]`."""
    weight: Tensor
    """Mixture weights w_i, `[M]`. Their sum over the candidates of a guided pixel is 1."""
    core: Any = None
    """The mixture in the native core, None if PyTorch holds it."""

    def __init__(self, lens: Lens, focus: Tensor, start: Tensor, count: int):
        super().__init__(lens)
        self.focus, self._start = focus, start
        self.owner = owners(start, count)
        """Pixel that owns each candidate, int64 `[M]`."""

    def _set_weights(self, beta: Tensor, weight: Tensor) -> None:
        """Set β `[N]` and the mixture weights. weight: unnormalised weights, `[M]`; 0 excludes a candidate."""
        total = torch.zeros(self.focus.shape[1], dtype=torch.float64, device=weight.device)
        total.index_add_(0, self.owner, weight.double())
        self.guided = total > 0.0
        self.beta = beta * self.guided
        self.weight, steps = _normalised(weight, total, self.owner)
        # Sums of whole numbers are exact, so that they do not depend on the batch of a pixel.
        cumulative = torch.zeros(len(steps) + 1, dtype=torch.int64, device=weight.device)
        torch.cumsum(steps, 0, out=cumulative[1:])
        self._ends = cumulative[1:]
        self._low, self._high = (cumulative.index_select(0, bound) for bound in (self._start[:-1], self._start[1:]))

    def choose(self, uniforms: Tensor) -> Tensor:
        """Draw a candidate for each pixel in proportion to the weights, int64 `[N]`, from uniform numbers `[N]`.

        If a pixel is not guided or a number is outside 0 … 1, the result is an arbitrary valid index.
        """
        passed = _ends_before(self._ends, self._low, self._high, uniforms, self.owner)
        return self._start[:-1].clone().index_add_(0, self.owner, passed).clamp_(max=len(self.owner) - 1)

    def component_pdf(self, points: Tensor) -> Tensor:
        """Densities p_i of all candidates, `[M]`, each at the lens point of the pixel that owns it. points: `[2, N]`."""
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

    def weights(self, at: LensDensity) -> Tensor:
        """W / (A q) of Eq. 11 at samples of the mixture, `[N]`; in pixels that are not guided, the unblocked share of W."""
        lens, unblocked = self.lens, self.lens.unblocked(at.points, self.focus)
        weight = lens.transmission(at.points) * unblocked / (lens.area * at.density).clamp(min=1e-20)
        return torch.where(self.guided, weight, unblocked)


def owners(start: Tensor, count: int) -> Tensor:
    """Pixel that owns each candidate of a packed list, int64 `[M]`. start: int64 `[N + 1]`; count: M."""
    return torch.repeat_interleave(start[1:] - start[:-1], output_size=count)


def _normalised(weight: Tensor, total: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """Weights `[M]` divided by the totals `[N]` of their owners: as float32, and rounded to whole WEIGHT_STEPS as int64."""
    share = weight.double() / total.clamp(min=1e-300).index_select(0, owner)  # a total of 0 gives weights of 0
    return share.float(), (share * WEIGHT_STEPS).long()


def _ends_before(ends: Tensor, low: Tensor, high: Tensor, uniforms: Tensor, owner: Tensor) -> Tensor:
    """1 for each candidate before the drawn candidate of the same pixel, else 0, int64 `[M]`.

    ends: cumulative weights of the packed list, `[M]`; low, high: their values before and after each pixel, `[N]`.
    """
    target = low + ((high - low) * uniforms.double()).long()
    return (ends <= target.index_select(0, owner)).long()
