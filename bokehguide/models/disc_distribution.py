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

FLATTEST = 1e-4
"""Least squared height of an ellipse by its squared height upright: panels seen from their edge are no lines."""


class DiscLensDistribution(LensMixture):
    """The mixture of ellipsoids projected through x_F onto the lens plane, as even ellipses.

    The projection is the affine one that holds at an ellipsoid's centre. Densities are per unit lens area. A candidate
    counts by the share of its ellipse that lies within the lens's circle, about.

    mean `[3, M]` (metres, camera frame) and outline `[6, M]`: centres and `packed` squared half axes of the candidates'
    ellipsoids, none of them in focus; all else is as in LensMixture.
    """

    def __init__(self, lens: Lens, focus: Tensor, beta: Tensor, start: Tensor, mean: Tensor, outline: Tensor, weight: Tensor):
        seen_from = focus.index_select(1, owners(start))
        self.center = project_to_lens(mean, seen_from)
        """Of the ellipses, `[2, M]`."""
        gap = seen_from[2] - mean[2]
        x, y = (mean[0:2] - seen_from[0:2]) / gap
        xx, xy, xz, yy, yz, zz = outline
        scale = (seen_from[2] / gap).abs()
        across = xx + x * (2.0 * xz + x * zz)
        both = xy + y * xz + x * yz + x * y * zz
        up = yy + y * (2.0 * yz + y * zz)
        width = across.clamp(min=1e-30).sqrt()
        tilt = both / width
        height = (up - tilt * tilt).clamp(min=FLATTEST * up).sqrt()
        self.width, self.tilt, self.height = scale * width, scale * tilt, scale * height
        """Columns (width, tilt) and (0, height) of what makes an ellipse of the unit disc, `[M]`."""
        super().__init__(lens, focus, beta, start, weight * overlap(self.center, (self.width * self.height).sqrt(), lens.radius))

    def sample(self, uniforms: Tensor) -> Tensor:
        """Lens points `[2, N]` from uniform numbers `[3, N]`; they may lie outside the aperture.

        The first number chooses, the others are the place: evenly spread numbers give
        evenly spread lens points, of every ellipse and of the aperture.
        """
        points = self.lens.sample(uniforms[1:3])
        index = (uniforms[0] < self.beta).nonzero()[:, 0]
        choice, radius, angle = uniforms[0:3].index_select(1, index)
        chosen = self.choose(index, choice / self.beta.index_select(0, index))
        radius, angle = (1.0 - 1e-6) * radius.sqrt(), 2.0 * math.pi * angle
        x, y = radius * angle.cos(), radius * angle.sin()
        width, tilt, height = (part.index_select(0, chosen) for part in (self.width, self.tilt, self.height))
        drawn = self.center.index_select(1, chosen) + torch.stack((width * x, tilt * x + height * y))
        return points.index_copy_(1, index, drawn)

    def component_pdf(self, points: Tensor) -> Tensor:
        x, y = (points.index_select(1, self.owner) - self.center).unbind(0)
        x = x / self.width
        y = (y - self.tilt * x) / self.height
        return (x * x + y * y <= 1.0) / (math.pi * self.width * self.height)


def packed(outline: Tensor) -> Tensor:
    """The six different entries `[6, M]` of symmetric `[M, 3, 3]`: xx, xy, xz, yy, yz, zz."""
    rows, columns = torch.triu_indices(3, 3, device=outline.device)
    return outline[:, rows, columns].T.contiguous()


def balls(radius: Tensor) -> Tensor:
    """Packed outlines `[6, M]` of discs of radius `[M]` parallel to the lens, which stand for balls."""
    squared, none = radius * radius, torch.zeros_like(radius)
    return torch.stack((squared, none, none, squared, none, none))


def overlap(center: Tensor, radius: Tensor, lens_radius: float) -> Tensor:
    """About the share `[N]` of discs `[2, N]` and `[N]` that lies within the circle of the lens; 0 where none of it does."""
    distance = center.square().sum(0).sqrt()
    smaller = radius.clamp(max=lens_radius)
    inside = ((lens_radius + radius - distance) / (2.0 * smaller)).clamp(0.0, 1.0)
    return inside * (smaller / radius).square()
