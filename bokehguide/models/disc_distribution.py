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

from bokehguide.models.lens_distribution import LensMixture
from bokehguide.models.panels import Panels, SeenPanels
from bokehguide.models.projection import project_to_lens
from bokehguide.models.sky_lamps import SeenSky, SkyLamps
from bokehguide.render.kernels import kernel
from bokehguide.render.lens import Lens
from bokehguide.render.pixels import put_where, worthwhile
from bokehguide.render.transfers import sent

FLATTEST = 1e-4
"""Least squared height of an ellipse by its squared height upright: panels seen from their edge are no lines."""
DEEPEST = 0.9
"""Most that a squared half axis along z is by the squared distance to x_F: of what reaches there the outline has no end."""
BEYOND = 1.001
"""Bands reach so far beyond the lens's circle, in lens radii: what rounding moves across their ends, the lens does not see."""
NARROWEST = -0.9
"""Where a band ends at least, as `Band.high`: of less, single precision does not tell the area."""


class Shapes(NamedTuple):
    """Candidates that have a shape of their own and are no ellipsoids: lamps of the map, and panels.

    sky_lamp, panel: which of either each candidate is, -1 for none, int64 `[M]`; light: luminance of each panel, `[P]`.
    """

    sky: SkyLamps | None
    sky_lamp: Tensor
    panels: Panels | None
    panel: Tensor
    light: Tensor


class Band(NamedTuple):
    """What is drawn of M ellipses: what lies between two tangents of the lens's circle, which face the way to their centres.

    In coordinates in which the ellipses are unit discs. along: the way that the centres lie, unit, `[2, M]`; low, high:
    where it begins and ends on that way, beyond -1 and 1 where nothing is cut off; below, share: of the disc, what lies
    before it and in it; `[M]` each.
    """

    along: Tensor
    low: Tensor
    high: Tensor
    below: Tensor
    share: Tensor


class Ellipses(NamedTuple):
    """Centres `[2, M]`, and columns (width, tilt) and (0, height) of what makes ellipses of the unit disc, `[M]`; their bands."""

    center: Tensor
    width: Tensor
    tilt: Tensor
    height: Tensor
    band: Band


class DiscLensDistribution(LensMixture):
    """The mixture of ellipsoids projected through x_F onto the lens plane, as even ellipses, cut off where the lens ends.

    An ellipse is the outline of its ellipsoid as x_F sees it. Densities are per unit lens area. A candidate
    counts by the root of the shares of its ellipse that lie within the lens's circle, about, and in its band: so the variance
    of what is drawn of ellipses is least. Lamps of the map and panels, of which nothing else is drawn, count by what passes the lens.

    mean `[3, M]` (metres, camera frame) and outline `[6, M]`: centres and `packed` squared half axes of the candidates'
    ellipsoids, none of them in focus; factor: what is known of their weights beside how bright they look, `[M]`; shapes:
    which of them are something else; all else is as in GuidedLensDistribution.
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
        super().__init__(lens, focus, start, len(weight))
        owner, radius, all_of_it = self.owner, sent(lens.radius, focus.device, torch.float32), weight
        self.ellipses, weight = _ellipses(mean, outline, focus.index_select(1, owner), weight, radius)
        self._parts: list[SeenSky | SeenPanels] = []
        if shapes is not None and shapes.sky is not None:
            share, whole = _within(self.ellipses, radius)
            sky = SeenSky(shapes.sky, shapes.sky_lamp, owner, focus, whole > 0.0)
            share = torch.minimum(share.index_select(0, sky.index), sky.share)
            put_where(sky.real, weight, sky.index, all_of_it.index_select(0, sky.index) * share)
            self._parts.append(sky)
        if shapes is not None and shapes.panels is not None:
            seen = SeenPanels(shapes.panels, shapes.panel, owner, focus, radius)
            light = shapes.light.index_select(0, shapes.panel.index_select(0, seen.index).clamp(min=0))
            put_where(seen.real, weight, seen.index, light * seen.size / math.pi)
            self._parts.append(seen)
        self.bright = weight
        """Luminance times area on the lens over π, `[M]`, times those shares or their root: what draws of each might bring, as
        their root mean square."""
        self.chosen = torch.full_like(start[1:], -1)
        """Candidate that each pixel's last sample was drawn from, -1 for none, int64 `[N]`."""
        self._weigh(beta, weight * factor)

    def sample(self, uniforms: Tensor) -> Tensor:
        """Lens points `[2, N]` from uniform numbers `[3, N]`; they may lie outside the aperture.

        The first number chooses, the others are the place: evenly spread numbers give
        evenly spread lens points, of every ellipse and of the aperture.
        """
        points, of_discs = self.lens.sample(uniforms[1:3]), uniforms[0] < self.beta
        chosen = self.choose(uniforms[0] / self.beta)
        self.chosen = torch.where(of_discs, chosen, -1)
        index = worthwhile(of_discs)
        chosen, numbers = chosen.index_select(0, index), uniforms[1:3].index_select(1, index)
        drawn = _drawn(self.ellipses, chosen, numbers)
        for part in self._parts:
            place = torch.full_like(self.owner, -1)
            put_where(part.real, place, part.index, torch.arange(len(part.index), device=place.device))
            place = place.index_select(0, chosen)
            own = worthwhile(place >= 0)
            place, others = place.index_select(0, own), numbers.index_select(1, own)
            put_where(place >= 0, drawn, own, part.sample(place.clamp(min=0), others))
        put_where(of_discs.index_select(0, index), points, index, drawn)
        return points

    def component_pdf(self, points: Tensor) -> Tensor:
        density = _density(points, self.owner, self.ellipses)
        for part in self._parts:
            put_where(part.real, density, part.index, part.pdf(points))
        return density


@kernel
def _ellipses(mean: Tensor, outline: Tensor, focus: Tensor, weight: Tensor, lens_radius: Tensor) -> tuple[Ellipses, Tensor]:
    """Outlines of ellipsoids seen through x_F, and what of their weights the lens can see.

    The planes through x_F that touch an ellipsoid of squared half axes S about x_F + e have normals n of nᵀ (e eᵀ - S) n = 0: that
    is the dual conic of the outline.
    """
    gap = focus[2] - mean[2]
    x, y = (mean[0:2] - focus[0:2]) / gap
    xx, xy, xz, yy, yz, zz = outline / (gap * gap)
    flatter = (DEEPEST / zz.clamp(min=1e-30)).sqrt().clamp(max=1.0)
    xz, yz, zz = flatter * xz, flatter * yz, flatter * flatter * zz
    scale = focus[2] / (1.0 - zz)
    center = project_to_lens(mean, focus) + scale * torch.stack((xz + x * zz, yz + y * zz))
    across = xx + x * (2.0 * xz + x * zz) - (xx * zz - xz * xz)
    both = xy + y * xz + x * yz + x * y * zz - (xy * zz - xz * yz)
    up = yy + y * (2.0 * yz + y * zz) - (yy * zz - yz * yz)
    width = across.clamp(min=1e-37).sqrt()
    tilt = both / width
    height = (up - tilt * tilt).clamp(min=FLATTEST * up).sqrt()
    width, tilt, height = scale * width, scale * tilt, scale * height
    band = _band(center, width, tilt, height, lens_radius)
    seen = (overlap(center, width, tilt, height, lens_radius) * band.share).sqrt()
    return Ellipses(center, width, tilt, height, band), weight * seen


def _band(center: Tensor, width: Tensor, tilt: Tensor, height: Tensor, lens_radius: Tensor) -> Band:
    """Bands of ellipses: as `Band` says, but for BEYOND and NARROWEST."""
    distance, across, up = _towards_lens(center, width, tilt, height, lens_radius)
    reach = (across * across + up * up).sqrt().clamp(min=1e-30)
    low, high = (-BEYOND * lens_radius - distance) / reach, (BEYOND * lens_radius - distance) / reach
    high = high.clamp(min=NARROWEST)
    below = _disc_share(low)
    share = (_disc_share(high) - below).clamp(min=1e-7)  # of the largest discs, the lens is nothing
    return Band(torch.stack((across, up)) / reach, low, high, below, share)


def _towards_lens(center: Tensor, width: Tensor, tilt: Tensor, height: Tensor, lens_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How far the centres of ellipses are from the lens's, and the way there in coordinates in which they are unit discs: two numbers,
    as long as an ellipse reaches on that way."""
    distance = center.square().sum(0).sqrt()
    centred = distance < 1e-6 * lens_radius  # any way will do
    x, y = center / torch.where(centred, 1.0, distance)
    x = torch.where(centred, 1.0, x)
    return distance, width * x + tilt * y, height * y


def _disc_share(x: Tensor) -> Tensor:
    """What of the unit disc lies before `x` `[M]` on any way through its centre."""
    x = x.clamp(-1.0, 1.0)
    return (torch.acos(-x) + x * (1.0 - x * x).sqrt()) / math.pi


def _disc_place(share: Tensor) -> Tensor:
    """The inverse of `_disc_share`, by Newton's method from a series."""
    half = torch.minimum(share, 1.0 - share).clamp(min=0.0)
    angle = ((1.5 * math.pi * half).clamp(min=1e-30).log() / 3.0).exp()  # `pow` rounds the last elements of an array otherwise
    angle = angle + angle * angle * angle / 15.0
    for _ in range(3):
        sine = angle.sin()
        angle = angle - 0.5 * (angle - sine * angle.cos() - math.pi * half) / (sine * sine).clamp(min=1e-12)
    return torch.where(share < 0.5, -angle.cos(), angle.cos())


@kernel
def _within(ellipses: Ellipses, lens_radius: Tensor) -> tuple[Tensor, Tensor]:
    """About the shares of ellipses that lie within the circle of the lens; and 1 for those that do so whole, 0 for others. `[M]` each."""
    center, width, tilt, height, _ = ellipses
    across, both, up = width * width, width * tilt, tilt * tilt + height * height
    longest = (0.5 * (across + up) + (0.25 * (across - up).square() + both * both).sqrt()).sqrt()
    whole = (center.square().sum(0).sqrt() + longest < lens_radius) + torch.zeros_like(width)
    return overlap(center, width, tilt, height, lens_radius), whole


@kernel
def _drawn(ellipses: Ellipses, chosen: Tensor, uniforms: Tensor) -> Tensor:
    """Points `[2, K]`, even over what is drawn of the ellipses at `chosen`, int64 `[K]`, from uniform numbers `[2, K]`."""
    center, width, tilt, height = (part.index_select(-1, chosen) for part in ellipses[:-1])
    band = Band(*(part.index_select(-1, chosen) for part in ellipses.band))
    radius, angle = (1.0 - 1e-6) * uniforms[0].sqrt(), 2.0 * math.pi * uniforms[1]
    along = _disc_place(band.below + uniforms[0] * band.share)
    across = (1.0 - 1e-6) * (1.0 - along * along).clamp(min=0.0).sqrt() * (2.0 * uniforms[1] - 1.0)
    whole = (band.low <= -1.0) & (band.high >= 1.0)
    x = torch.where(whole, radius * angle.cos(), band.along[0] * along - band.along[1] * across)
    y = torch.where(whole, radius * angle.sin(), band.along[1] * along + band.along[0] * across)
    return center + torch.stack((width * x, tilt * x + height * y))


@kernel
def _density(points: Tensor, owner: Tensor, ellipses: Ellipses) -> Tensor:
    """Of what is drawn of even ellipses at the points `[2, N]` of those that own them, `[M]`."""
    center, width, tilt, height, band = ellipses
    x, y = points.index_select(1, owner) - center
    x = x / width
    y = (y - tilt * x) / height
    along = band.along[0] * x + band.along[1] * y
    drawn = (x * x + y * y <= 1.0) & (along >= band.low) & (along <= band.high)
    return drawn / (math.pi * width * height * band.share)


def packed(outline: Tensor) -> Tensor:
    """The six different entries `[6, M]` of symmetric `[M, 3, 3]`: xx, xy, xz, yy, yz, zz."""
    rows, columns = torch.triu_indices(3, 3, device=outline.device)
    return outline[:, rows, columns].T.contiguous()


def balls(radius: Tensor) -> Tensor:
    """Packed outlines `[6, M]` of balls of radius `[M]`."""
    squared, none = radius * radius, torch.zeros_like(radius)
    return torch.stack((squared, none, none, squared, none, squared))


def overlap(center: Tensor, width: Tensor, tilt: Tensor, height: Tensor, lens_radius: Tensor) -> Tensor:
    """About the share `[N]` of ellipses (see `Ellipses`) that lies within the circle of the lens; 0 where none of it does."""
    distance, across, up = _towards_lens(center, width, tilt, height, lens_radius)
    reach = (across * across + up * up).sqrt().clamp(min=1e-30)
    inside = ((lens_radius + reach - distance) / (2.0 * torch.minimum(reach, lens_radius))).clamp(0.0, 1.0)
    return inside * (lens_radius * lens_radius / (width * height)).clamp(max=1.0)
