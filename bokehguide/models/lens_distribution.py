"""Distributions of lens points: `sample`, `pdf` and `log_prob` in the manner of torch.distributions.

Lens points are `[2, N]` in metres in the camera frame; densities are per unit lens area.
Uniform numbers come from the caller, who keys them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.models.projection import lens_density, project_to_lens
from bokehguide.render.kernels import kernel
from bokehguide.render.lens import Lens
from bokehguide.render.pixels import put_where, worthwhile
from bokehguide.render.transfers import sent

WHOLE = 2.0**40
"""Of which a candidate's share is a whole part when it is drawn."""


class UniformLensDistribution:
    """p_U = W/A on the aperture, 1/A on a round one (Eq. 9), for N pixels."""

    def __init__(self, lens: Lens):
        self.lens = lens

    def sample(self, uniforms: Tensor) -> Tensor:
        """Lens points `[2, N]` from uniform numbers `[2, N]`."""
        return self.lens.sample(uniforms)

    def pdf(self, points: Tensor) -> Tensor:
        """W/A as it is on the axis, 0 outside the aperture, `[N]`."""
        return self.lens.transmission(points) / self.lens.area

    def log_prob(self, points: Tensor) -> Tensor:
        """Logarithm of `pdf`, -inf outside."""
        return self.pdf(points).log()


class LensDensity(NamedTuple):
    """A guided distribution at one lens point `[2, N]` for each pixel.

    components: p_i of every candidate, `[M]`; mixture: p_GMM `[N]`; density: q `[N]`.
    """

    points: Tensor
    components: Tensor
    mixture: Tensor
    density: Tensor


class LensMixture:
    """q = β Σ w_i p_i + (1 - β) W / A (Eq. 26), one mixture for each of N pixels.

    Candidates are packed: those of pixel i stand at `start[i] : start[i + 1]`. A pixel
    without one falls back to the uniform distribution. The p_i may reach beyond the
    aperture: draws outside are samples of value 0. A kind of mixture adds `component_pdf` and
    `sample`, and gives β and weights to `_weigh` when it is made.

    lens: the aperture. focus: x_F `[3, N]`. start: int64 `[N + 1]`. count: M, of candidates.
    """

    def __init__(self, lens: Lens, focus: Tensor, start: Tensor, count: int):
        self.lens, self.focus, self._start = lens, focus, start
        self.owner = owners(start, count)
        """Pixel `[M]` that each candidate belongs to."""

    def _weigh(self, beta: Tensor, weight: Tensor) -> None:
        """Set β `[N]` and the mixture's weights, from weights `[M]` of any scale, 0 for a candidate that is left out."""
        total = torch.zeros(self.focus.shape[1], dtype=torch.float64, device=weight.device)
        total.index_add_(0, self.owner, weight.double())
        self.guided = total > 0.0
        """Pixels that have anything to be guided by, bool `[N]`."""
        self.beta = beta * self.guided
        self.weight, whole = _shares(weight, total, self.owner)
        """Mixture weights `[M]`, which sum to 1 over the candidates of a guided pixel."""
        # Whole numbers add up the same wherever a batch begins.
        cumulative = torch.zeros(len(whole) + 1, dtype=torch.int64, device=weight.device)
        torch.cumsum(whole, 0, out=cumulative[1:])
        self._ends, self._low, self._high = cumulative[1:], *(cumulative.index_select(0, of) for of in (self._start[:-1], self._start[1:]))

    def choose(self, uniforms: Tensor) -> Tensor:
        """A candidate of each pixel, int64 `[N]`, drawn by weight with uniform numbers `[N]`; for pixels that have none, and numbers
        that are not from 0 to 1, anyone's."""
        passed = _passed(self._ends, self._low, self._high, uniforms, self.owner)
        return self._start[:-1].clone().index_add_(0, self.owner, passed).clamp_(max=len(self.owner) - 1)

    def component_pdf(self, points: Tensor) -> Tensor:
        """p_i at each pixel's lens point, for all of its candidates, `[M]`."""
        raise NotImplementedError

    def mixture_pdf(self, components: Tensor) -> Tensor:
        """p_GMM `[N]` from `component_pdf`."""
        mixture = torch.zeros(self.focus.shape[1], device=components.device)
        return mixture.index_add_(0, self.owner, self.weight * components)

    def evaluate(self, points: Tensor) -> LensDensity:
        """All densities at lens points `[2, N]`, on the whole lens plane."""
        components = self.component_pdf(points)
        mixture = self.mixture_pdf(components)
        return LensDensity(points, components, mixture, self.blend(points, mixture))

    def blend(self, points: Tensor, mixture: Tensor) -> Tensor:
        """q of Eq. 26, `[N]`, from p_GMM `[N]`."""
        return self.beta * mixture + (1.0 - self.beta) * self.lens.transmission(points) / self.lens.area

    def pdf(self, points: Tensor) -> Tensor:
        """q at one lens point for each pixel, `[N]`."""
        return self.evaluate(points).density

    def log_prob(self, points: Tensor) -> Tensor:
        """Logarithm of `pdf`, `[N]`."""
        return self.pdf(points).log()


@kernel
def _shares(weight: Tensor, total: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """Weights `[M]` over the totals `[N]` of those that own them; and the same in whole parts, int64."""
    share = weight.double() / total.clamp(min=1e-300).index_select(0, owner)
    return share.float(), (share * WHOLE).long()


@kernel
def _passed(ends: Tensor, low: Tensor, high: Tensor, uniforms: Tensor, owner: Tensor) -> Tensor:
    """1 for the candidates that stand before the one that each pixel draws, 0 for the others, int64 `[M]`.

    ends: sums of whole parts up to each candidate, `[M]`; low, high: what they are before and after each pixel's, `[N]`.
    """
    target = low + ((high - low) * uniforms.double()).long()
    return (ends <= target.index_select(0, owner)).long()


def owners(start: Tensor, count: int) -> Tensor:
    """Pixel int64 `[M]` that each candidate of a packed list belongs to; start: int64 `[N + 1]`; count: M."""
    return torch.repeat_interleave(start[1:] - start[:-1], output_size=count)


class GuidedLensDistribution(LensMixture):
    """The mixture of 3D Gaussians projected by bipolar cones (Eq. 18-22).

    Candidates that Eq. 22 culls are left out. mean `[3, M]` and sigma `[M]` (metres, camera
    frame): the candidates' Gaussians; beta: β `[N]`; weight: of the candidates, of any scale, `[M]`; all else is as in LensMixture.
    """

    def __init__(self, lens: Lens, focus: Tensor, beta: Tensor, start: Tensor, mean: Tensor, sigma: Tensor, weight: Tensor):
        super().__init__(lens, focus, start, len(weight))
        self.mean, self.sigma = mean, sigma
        radius = sent(lens.radius, focus.device, torch.float32)
        self._weigh(beta, weight * _kept(mean, sigma, focus, self.owner, radius))

    def sample(self, uniforms: Tensor) -> Tensor:
        """Lens points `[2, N]` from uniform numbers `[5, N]`; they may lie outside the aperture.

        A guided draw is a point of the 3D Gaussian, projected through x_F (section 4.1.3).
        """
        points = self.lens.sample(uniforms[2:4])
        guided = uniforms[0] < self.beta
        index = worthwhile(guided)
        chosen = self.choose(uniforms[1]).index_select(0, index)
        normals = math.sqrt(2.0) * torch.erfinv(2.0 * uniforms[2:5].index_select(1, index) - 1.0)
        spot = self.mean.index_select(1, chosen) + self.sigma.index_select(0, chosen) * normals
        drawn = project_to_lens(spot, self.focus.index_select(1, index))
        drawn = drawn.nan_to_num(1e30, 1e30, -1e30).clamp(-1e15, 1e15)
        put_where(guided.index_select(0, index), points, index, drawn)
        return points

    def component_pdf(self, points: Tensor) -> Tensor:
        return _density(points, self.focus, self.owner, self.mean, self.sigma)


@kernel
def _kept(mean: Tensor, sigma: Tensor, focus: Tensor, owner: Tensor, lens_radius: Tensor) -> Tensor:
    """C_G of Eq. 22: the projected mean lies within r + |k|σ of the lens centre; float32 `[M]`."""
    focus = focus.index_select(1, owner)
    x, y = project_to_lens(mean, focus)
    reach = lens_radius + (focus[2] / (focus[2] - mean[2])).abs() * sigma
    return (x * x + y * y < reach * reach).to(torch.float32)


@kernel
def _density(points: Tensor, focus: Tensor, owner: Tensor, mean: Tensor, sigma: Tensor) -> Tensor:
    """Of the candidates at the lens points of those that own them, `[M]`."""
    return lens_density(points.index_select(1, owner), focus.index_select(1, owner), mean, sigma)
