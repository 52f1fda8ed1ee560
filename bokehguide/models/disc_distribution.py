"""Highlights as even discs on the lens, or in shapes of their own: the density that mode `guided` draws from.

A ball seen through a focus point x_F covers a disc of the lens, and lights it evenly. A
Gaussian has to be cut to that disc by the estimator: at the best σ, R / 1.78, its weights have
a second moment of 1.54. That of an even disc as large as the ball's is 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.models.lens_distribution import LensMixture, owners
from bokehguide.models.panels import Panels, SeenPanels
from bokehguide.models.projection import project_to_lens
from bokehguide.models.sky_lamps import SeenSky, SkyLamps
from bokehguide.render.kernels import kernel
from bokehguide.render.lens import Lens

FLATTEST = 1e-4
"""Least squared height of an ellipse by its squared height upright: panels seen from their edge are no lines."""


class Shapes(NamedTuple):
    """Candidates that have a shape of their own and are no ellipsoids: lamps of the map, and panels.

    sky_lamp, panel: which of either each candidate is, -1 for none, int64 `[M]`; light: luminance of each panel, `[P]`.
    """

    sky: SkyLamps | None
    sky_lamp: Tensor
    panels: Panels | None
    panel: Tensor
    light: Tensor


class DiscLensDistribution(LensMixture):
    """The mixture of ellipsoids projected through x_F onto the lens plane, as even ellipses.

    The projection is the affine one that holds at an ellipsoid's centre. Densities are per unit lens area. A candidate
    counts by the share of its ellipse that lies within the lens's circle, about.

    mean `[3, M]` (metres, camera frame) and outline `[6, M]`: centres and `packed` squared half axes of the candidates'
    ellipsoids, none of them in focus; factor: what is known of their weights beside how bright they look, `[M]`; shapes:
    which of them are something else; all else is as in LensMixture.
    """

    def __init__(
        self,
        lens: Lens,
        focus: Tensor,
        beta: Tensor,
        start: Tensor,
        mean: Tensor,
        outline: Tensor,
        weight: Tensor,
        factor: Tensor,
        shapes: Shapes | None = None,
    ):
        owner, radius = owners(start), torch.tensor(lens.radius, device=focus.device)
        ellipses = _ellipses(mean, outline, focus.index_select(1, owner), weight, radius)
        self.center, self.width, self.tilt, self.height, weight = ellipses
        """Of the ellipses: centres `[2, M]`, and columns (width, tilt) and (0, height) of what makes one of the unit disc, `[M]`."""
        self._parts: list[SeenSky | SeenPanels] = []
        if shapes is not None and shapes.sky is not None:
            self._parts.append(SeenSky(shapes.sky, shapes.sky_lamp, owner, focus))
        if shapes is not None and shapes.panels is not None:
            seen = SeenPanels(shapes.panels, shapes.panel, owner, focus, radius)
            light = shapes.light.index_select(0, shapes.panel.index_select(0, seen.index))
            weight.index_copy_(0, seen.index, light * seen.size / math.pi)
            self._parts.append(seen)
        self.bright = weight
        """Luminance times area on the lens over π, `[M]`: what a draw of each might bring."""
        self.chosen = torch.full_like(start[1:], -1)
        """Candidate that each pixel's last sample was drawn from, -1 for none, `[N]`."""
        super().__init__(lens, focus, beta, start, weight * factor)

    def sample(self, uniforms: Tensor) -> Tensor:
        """Lens points `[2, N]` from uniform numbers `[3, N]`; they may lie outside the aperture.

        The first number chooses, the others are the place: evenly spread numbers give
        evenly spread lens points, of every ellipse and of the aperture.
        """
        points = self.lens.sample(uniforms[1:3])
        index = (uniforms[0] < self.beta).nonzero()[:, 0]
        choice, radius, angle = uniforms[0:3].index_select(1, index)
        chosen = self.choose(index, choice / self.beta.index_select(0, index))
        self.chosen.index_copy_(0, index, chosen)
        radius, angle = (1.0 - 1e-6) * radius.sqrt(), 2.0 * math.pi * angle
        x, y = radius * angle.cos(), radius * angle.sin()
        width, tilt, height = (part.index_select(0, chosen) for part in (self.width, self.tilt, self.height))
        drawn = self.center.index_select(1, chosen) + torch.stack((width * x, tilt * x + height * y))
        for part in self._parts:
            place = torch.full_like(self.owner, -1)
            place[part.index] = torch.arange(len(part.index), device=place.device)
            place = place.index_select(0, chosen)
            own = (place >= 0).nonzero()[:, 0]
            numbers = uniforms[1:3].index_select(1, index.index_select(0, own))
            drawn.index_copy_(1, own, part.sample(place.index_select(0, own), numbers))
        return points.index_copy_(1, index, drawn)

    def component_pdf(self, points: Tensor) -> Tensor:
        density = _density(points.index_select(1, self.owner), self.center, self.width, self.tilt, self.height)
        for part in self._parts:
            density.index_copy_(0, part.index, part.pdf(points))
        return density


@kernel
def _ellipses(mean: Tensor, outline: Tensor, focus: Tensor, weight: Tensor, lens_radius: Tensor) -> tuple[Tensor, ...]:
    """Centres, widths, tilts and heights of ellipsoids projected through x_F, and what of their weights the lens can see."""
    center = project_to_lens(mean, focus)
    gap = focus[2] - mean[2]
    x, y = (mean[0:2] - focus[0:2]) / gap
    xx, xy, xz, yy, yz, zz = outline
    scale = (focus[2] / gap).abs()
    across = xx + x * (2.0 * xz + x * zz)
    both = xy + y * xz + x * yz + x * y * zz
    up = yy + y * (2.0 * yz + y * zz)
    width = across.clamp(min=1e-30).sqrt()
    tilt = both / width
    height = (up - tilt * tilt).clamp(min=FLATTEST * up).sqrt()
    width, tilt, height = scale * width, scale * tilt, scale * height
    return center, width, tilt, height, weight * overlap(center, (width * height).sqrt(), lens_radius)


@kernel
def _density(points: Tensor, center: Tensor, width: Tensor, tilt: Tensor, height: Tensor) -> Tensor:
    """Of even ellipses at points `[2, M]`, `[M]`."""
    x, y = points - center
    x = x / width
    y = (y - tilt * x) / height
    return (x * x + y * y <= 1.0) / (math.pi * width * height)


def packed(outline: Tensor) -> Tensor:
    """The six different entries `[6, M]` of symmetric `[M, 3, 3]`: xx, xy, xz, yy, yz, zz."""
    rows, columns = torch.triu_indices(3, 3, device=outline.device)
    return outline[:, rows, columns].T.contiguous()


def balls(radius: Tensor) -> Tensor:
    """Packed outlines `[6, M]` of discs of radius `[M]` parallel to the lens, which stand for balls."""
    squared, none = radius * radius, torch.zeros_like(radius)
    return torch.stack((squared, none, none, squared, none, none))


def overlap(center: Tensor, radius: Tensor, lens_radius: Tensor) -> Tensor:
    """About the share `[N]` of discs `[2, N]` and `[N]` that lies within the circle of the lens, `[]`; 0 where none of it does."""
    distance = center.square().sum(0).sqrt()
    smaller = torch.minimum(radius, lens_radius)
    inside = ((lens_radius + radius - distance) / (2.0 * smaller)).clamp(0.0, 1.0)
    return inside * (smaller / radius).square()
