"""Distributions of lens points: `sample`, `pdf` and `log_prob` in the manner of torch.distributions.

Lens points are `[2, N]` in metres in the camera frame; densities are per unit lens area.
Uniform numbers come from the caller, who keys them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from bokehguide.models.projection import lens_density, project_to_lens
from bokehguide.render.lens import Lens
from bokehguide.render.pixels import indices

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
    `sample`.

    lens: the aperture. focus: x_F `[3, N]`. beta: β `[N]`. start: int64 `[N + 1]`.
    weight: of the candidates, any scale, 0 for one that is left out, `[M]`.
    """

    def __init__(self, lens: Lens, focus: Tensor, beta: Tensor, start: Tensor, weight: Tensor):
        self.lens, self.focus = lens, focus
        self.owner = owners(start, len(weight))
        """Pixel `[M]` that each candidate belongs to."""
        kept = weight.double()
        total = torch.zeros(focus.shape[1], dtype=torch.float64, device=kept.device).index_add_(0, self.owner, kept)
        share = kept / total.clamp(min=1e-300).index_select(0, self.owner)
        self.guided = total > 0.0
        """Pixels that have anything to be guided by, bool `[N]`."""
        self.beta = beta * self.guided
        self.weight = share.float()
        """Mixture weights `[M]`, which sum to 1 over the candidates of a guided pixel."""
        # Whole numbers add up the same wherever a batch begins.
        self._cumulative = pad((share * WHOLE).long().cumsum(0), (1, 0))
        self._low, self._high = self._cumulative[start[:-1]], self._cumulative[start[1:]]

    def choose(self, index: Tensor, uniforms: Tensor) -> Tensor:
        """Candidates `[K]` of the pixels at `index` `[K]`, drawn by weight."""
        low, high = self._low.index_select(0, index), self._high.index_select(0, index)
        target = low + ((high - low) * uniforms.double()).long()
        found = torch.searchsorted(self._cumulative, target, right=True) - 1
        return found.clamp(max=len(self.weight) - 1)

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


def owners(start: Tensor, count: int) -> Tensor:
    """Pixel int64 `[M]` that each candidate of a packed list belongs to; start: int64 `[N + 1]`; count: M."""
    return torch.repeat_interleave(start[1:] - start[:-1], output_size=count)


class GuidedLensDistribution(LensMixture):
    """The mixture of 3D Gaussians projected by bipolar cones (Eq. 18-22).

    Candidates that Eq. 22 culls are left out. mean `[3, M]` and sigma `[M]` (metres, camera
    frame): the candidates' Gaussians; all else is as in LensMixture.
    """

    def __init__(self, lens: Lens, focus: Tensor, beta: Tensor, start: Tensor, mean: Tensor, sigma: Tensor, weight: Tensor):
        self.mean, self.sigma = mean, sigma
        self._focus = focus.index_select(1, owners(start, len(weight)))
        super().__init__(lens, focus, beta, start, weight * self._is_kept(lens))

    def _is_kept(self, lens: Lens) -> Tensor:
        """C_G of Eq. 22: the projected mean lies within r + |k|σ of the lens centre; float32 `[M]`."""
        k = self._focus[2] / (self._focus[2] - self.mean[2])
        x, y = project_to_lens(self.mean, self._focus).unbind(0)
        reach = lens.radius + k.abs() * self.sigma
        return (x * x + y * y < reach * reach).to(torch.float32)

    def sample(self, uniforms: Tensor) -> Tensor:
        """Lens points `[2, N]` from uniform numbers `[5, N]`; they may lie outside the aperture.

        A guided draw is a point of the 3D Gaussian, projected through x_F (section 4.1.3).
        """
        points = self.lens.sample(uniforms[2:4])
        index = indices(uniforms[0] < self.beta)
        chosen = self.choose(index, uniforms[1, index])
        normals = math.sqrt(2.0) * torch.erfinv(2.0 * uniforms[2:5, index] - 1.0)
        spot = self.mean[:, chosen] + self.sigma[chosen] * normals
        points[:, index] = project_to_lens(spot, self.focus[:, index]).nan_to_num(1e30, 1e30, -1e30).clamp(-1e15, 1e15)
        return points

    def component_pdf(self, points: Tensor) -> Tensor:
        return lens_density(points.index_select(1, self.owner), self._focus, self.mean, self.sigma)
