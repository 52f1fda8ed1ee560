"""Highlights as even discs on the lens: the density that mode `guided` draws from.

A ball seen through a focus point x_F covers a disc of the lens, and lights it evenly. A
Gaussian has to be cut to that disc by the estimator: at the best σ, R / 1.78, its weights have
a second moment of 1.54. That of an even disc as large as the ball's is 1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.models.lens_distribution import LensMixture, owners
from bokehguide.models.projection import project_to_lens
from bokehguide.render.lens import Lens


class DiscLensDistribution(LensMixture):
    """The mixture of balls projected through x_F onto the lens plane, as discs.

    The projection is that of the disc through the ball's centre parallel to the lens: centre
    `project_to_lens`, radius |k| R. Densities are per unit lens area. A candidate counts by
    the share of its disc that lies within the lens's circle.

    mean `[3, M]` and radius `[M]` (metres, camera frame): the candidates' balls, none of
    them in focus; all else is as in LensMixture.
    """

    def __init__(self, lens: Lens, focus: Tensor, beta: Tensor, start: Tensor, mean: Tensor, radius: Tensor, weight: Tensor):
        seen_from = focus.index_select(1, owners(start))
        self.center = project_to_lens(mean, seen_from)
        """Of the discs, `[2, M]`."""
        self.radius = (seen_from[2] / (seen_from[2] - mean[2])).abs() * radius
        """Of the discs, `[M]`."""
        super().__init__(lens, focus, beta, start, weight * overlap(self.center, self.radius, lens.radius))

    def sample(self, uniforms: Tensor) -> Tensor:
        """Lens points `[2, N]` from uniform numbers `[3, N]`; they may lie outside the aperture.

        The first number chooses, the others are the place: evenly spread numbers give
        evenly spread lens points, of every disc and of the aperture.
        """
        points = self.lens.sample(uniforms[1:3])
        index = (uniforms[0] < self.beta).nonzero()[:, 0]
        chosen = self.choose(index, uniforms[0, index] / self.beta[index])
        radius = self.radius[chosen] * (1.0 - 1e-6) * uniforms[1, index].sqrt()
        angle = 2.0 * math.pi * uniforms[2, index]
        points[:, index] = self.center[:, chosen] + radius * torch.stack((angle.cos(), angle.sin()))
        return points

    def component_pdf(self, points: Tensor) -> Tensor:
        x, y = (points.index_select(1, self.owner) - self.center).unbind(0)
        squared = self.radius * self.radius
        return (x * x + y * y <= squared) / (math.pi * squared)


def overlap(center: Tensor, radius: Tensor, lens_radius: float) -> Tensor:
    """About the share `[N]` of discs `[2, N]` and `[N]` that lies within the circle of the lens; 0 where none of it does."""
    distance = center.square().sum(0).sqrt()
    smaller = radius.clamp(max=lens_radius)
    inside = ((lens_radius + radius - distance) / (2.0 * smaller)).clamp(0.0, 1.0)
    return inside * (smaller / radius).square()
