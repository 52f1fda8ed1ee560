"""The lens distribution of the paper: 3D Gaussians projected through the focus point (Eq. 18-22 and 26)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.models.base import LensMixture, LensSample
from bokehguide.models.projection import FAR_OUTSIDE, lens_density, project_to_lens
from bokehguide.render.lens import Lens
from bokehguide.runtime.device import to_device
from bokehguide.runtime.indexing import ActiveEntries


class GaussianMixture(LensMixture):
    """A mixture of 3D Gaussians projected through x_F by bipolar cones (Eq. 16-21). Eq. 22 excludes candidates.

    mean: `[3, M]`, metres, camera frame. sigma: `[M]`, metres. beta: β, `[N]`. weight: unnormalised weights of the candidates,
    `[M]`. For the other arguments, see `LensMixture`.
    """

    def __init__(self, lens: Lens, focus: Tensor, beta: Tensor, start: Tensor, mean: Tensor, sigma: Tensor, weight: Tensor):
        super().__init__(lens, focus, start, len(weight))
        self.mean, self.sigma = mean, sigma
        radius = to_device(lens.radius, focus.device, torch.float32)
        self._set_weights(beta, weight * _kept(mean, sigma, focus, self.owner, radius))

    def sample(self, uniforms: Tensor) -> LensSample:
        """One lens point for each pixel, from uniform numbers `[5, N]`; candidates are not reported.

        A guided lens point is a random point of the 3D Gaussian, projected through x_F (section 4.1.3).
        """
        points = self.lens.sample(uniforms[2:4])
        guided = ActiveEntries(uniforms[0] < self.beta)
        candidate = guided.select(self.choose(uniforms[1]))
        normals = math.sqrt(2.0) * torch.erfinv(2.0 * guided.select(uniforms[2:5]) - 1.0)
        highlight = self.mean.index_select(1, candidate) + self.sigma.index_select(0, candidate) * normals
        drawn = project_to_lens(highlight, guided.select(self.focus))
        drawn = drawn.nan_to_num(1e30, 1e30, -1e30).clamp(-FAR_OUTSIDE, FAR_OUTSIDE)  # a point in focus has no projection
        guided.scatter(points, drawn)
        return LensSample(points)

    def component_pdf(self, points: Tensor) -> Tensor:
        points, focus = (values.index_select(1, self.owner) for values in (points, self.focus))
        return lens_density(points, focus, self.mean, self.sigma)


def _kept(mean: Tensor, sigma: Tensor, focus: Tensor, owner: Tensor, lens_radius: Tensor) -> Tensor:
    """C_G of Eq. 22: 1 if the projected mean lies within r + |k|σ of the lens centre, else 0; float32 `[M]`."""
    focus = focus.index_select(1, owner)
    x, y = project_to_lens(mean, focus)
    reach = lens_radius + (focus[2] / (focus[2] - mean[2])).abs() * sigma
    return (x * x + y * y < reach * reach).to(torch.float32)
