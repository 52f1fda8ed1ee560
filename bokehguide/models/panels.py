"""Flat lamps of four corners, a window or a soft box, seen through a focus point on the lens in their own shape.

The line from a lens point through x_F meets a panel's plane in one point, so that a density over the panel is one over
the lens plane: exactly, however near or tilted the panel is. What of a panel lies beyond the lens is not drawn.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.models.projection import FAR_OUTSIDE, project_to_lens
from bokehguide.render.kernels import kernel, record
from bokehguide.render.pixels import worthwhile
from bokehguide.render.vector import cross, dot

ROUNDING = 1e-6
"""Of what lens points are rounded to, by their size: 16 times as much."""
BEYOND = 1.001
"""So many lens radii is the lens taken to be wide: what rounding moves across the end of what is drawn, it does not see."""
QUADRATURE = (0.2113, 0.7887)
"""Gauss's two nodes between 0 and 1."""


@record
class Panels:
    """P parallelograms in the camera frame: centres and half edges, `[3, P]` each, metres."""

    def __init__(self, centre: Tensor, right: Tensor, up: Tensor):
        self._centre, self._right, self._up = centre, right, up
        normal = cross(right, up)
        self._area = 4.0 * dot(normal, normal).sqrt()
        self._normal = normal / (0.25 * self._area)
        # Rows that tell the coordinates -1 … 1 of a point of the plane along the half edges.
        self._across = cross(up, self._normal) / dot(right, cross(up, self._normal))
        self._along = cross(right, self._normal) / dot(up, cross(right, self._normal))

    def __len__(self) -> int:
        return self._centre.shape[1]

    def select(self, index: Tensor) -> Panels:
        """Those at `index`, one for each of M candidates."""
        chosen = object.__new__(Panels)
        for name, value in vars(self).items():
            setattr(chosen, name, value.index_select(-1, index))
        return chosen

    def coordinates(self, points: Tensor, focus: Tensor) -> tuple[Tensor, Tensor]:
        """Where lines from lens points `[2, P]` through x_F `[3, P]` meet the panels' planes.

        Coordinates `[2, P]` along the half edges, -1 … 1 on the panel, and what part of the panel's area an area on the
        lens plane is stretched over, `[P]`. All is reckoned from the middle, however far away x_F and however small the panel.
        """
        offset = self._centre - focus
        ray = torch.cat((focus[:2] - points, focus[2:3]))
        towards = dot(self._normal, ray)
        towards = torch.where(towards == 0.0, 1e-30, towards)
        way = dot(self._normal, offset) / towards
        aside = torch.cat((points - project_to_lens(self._centre, focus), torch.zeros_like(points[:1])))
        found = dot(self._normal, aside) / towards * offset - way * aside
        stretch = way.square() * (focus[2] / towards).abs() / self._area
        return torch.stack((dot(self._across, found), dot(self._along, found))), stretch

    def _margin(self, focus: Tensor, radius: Tensor) -> Tensor:
        """By how much more than the panels is drawn through x_F `[3, P]`, in coordinates, `[2, P]`.

        Draws are rounded. One on the panel must not be taken for one outside what is drawn: it would count for far too much.
        """
        offset = self._centre - focus
        digits = ROUNDING * (project_to_lens(self._centre, focus).square().sum(0).sqrt() + radius)
        beyond = dot(self._normal, offset)
        beyond = torch.where(beyond == 0.0, 1e-30, beyond)
        gradients = [dot(row, offset) / beyond * self._normal - row for row in (self._across, self._along)]
        length = torch.stack([gradient[:2].square().sum(0).sqrt() for gradient in gradients])
        return ((offset[2] / focus[2]).abs() * length * digits).nan_to_num(1.0, 1.0).clamp(1e-5, 1.0)

    def window(self, focus: Tensor, radius: Tensor) -> Tensor:
        """What of the panels the lens can see through x_F `[3, P]`: low and high coordinates `[2, 2, P]`, equal for nothing.

        radius: of the lens, `[]`. A coordinate is the quotient of two linear functions of the lens point. It is highest and
        lowest where one of its level lines touches the lens's circle.
        """
        offset, seen = self._centre - focus, project_to_lens(self._centre, focus)
        beyond, squared = dot(self._normal, offset), (BEYOND * radius).square()
        below, slope = dot(self._normal, focus / focus[2]), -self._normal[:2] / focus[2]
        scale = below.square() - squared * slope.square().sum(0)
        whole = scale <= 0.0  # the plane cuts the lens: its image has no bounds
        ranges = []
        for row in (self._across, self._along):
            gradient = (dot(row, offset) * self._normal[:2] - row[:2] * beyond) / focus[2]
            above = -(gradient * seen).sum(0)
            middle = above * below - squared * (gradient * slope).sum(0)
            turned = gradient[0] * slope[1] - gradient[1] * slope[0]
            apart = squared * ((above * slope - below * gradient).square().sum(0) - squared * turned.square())
            half = apart.clamp(min=0.0).sqrt()
            ends = torch.stack((middle - half, middle + half)) / scale
            ranges.append(torch.where(whole, torch.stack((-torch.ones_like(half), torch.ones_like(half))) * torch.inf, ends))
        most = 1.0 + self._margin(focus, radius)
        window = torch.maximum(torch.minimum(torch.stack(ranges, dim=1).nan_to_num(0.0), most), -most)
        # Where the ends of the first lie before or beyond all of the second, it ends sooner.
        ends = []
        for end in window[:, 0]:
            low, high = self._chord(end, 0, window, focus, radius)
            ends.append(self._chord(0.5 * (low + high), 1, window, focus, radius)[len(ends)])
        return torch.stack((torch.stack(ends), window[:, 1]), dim=1)

    def _on_lens(self, place: Tensor, focus: Tensor) -> Tensor:
        """Lens points `[2, P]` that see coordinates `[2, P]` through x_F `[3, P]`."""
        offset, aside = self._centre - focus, place[0] * self._right + place[1] * self._up
        shift = (offset[:2] * (aside[2] / offset[2]) - aside[:2]) * (focus[2] / (offset[2] + aside[2]))
        return project_to_lens(self._centre, focus) + shift

    def _chord(self, at: Tensor, axis: int, window: Tensor, focus: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
        """From where to where the lens sees a panel at places `at` `[P]` along one axis, along the other: two `[P]`, equal for nowhere.

        A line on the panel is one on the lens, where its circle cuts a chord out of it.
        """
        low, high = window[:, 1 - axis]
        fixed, moving = (self._right, self._up) if axis == 0 else (self._up, self._right)
        first, last = (self._on_lens(torch.stack((at, other) if axis == 0 else (other, at)), focus) for other in (low, high))
        length = (last - first).square().sum(0).sqrt().clamp(min=1e-30)
        way = (last - first) / length
        nearest = -(first * way).sum(0)
        reach = BEYOND * radius + ROUNDING * length
        half = (reach * reach - (first + nearest * way).square().sum(0)).clamp(min=0.0).sqrt()
        depth = self._centre[2] - focus[2] + at * fixed[2]
        ends = []
        for way, otherwise in (((nearest - half) / length, 0.0), ((nearest + half) / length, 1.0)):
            way = way.nan_to_num(otherwise, 1.0, 0.0).clamp(0.0, 1.0)
            far = way * (depth + low * moving[2])
            share = (far / (far + (1.0 - way) * (depth + high * moving[2]))).nan_to_num(otherwise).clamp(0.0, 1.0)
            ends.append(low + share * (high - low))
        return ends[0], ends[1]

    def sample(self, window: Tensor, focus: Tensor, radius: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, P]` that see panels through x_F `[3, P]`, from uniform numbers `[2, P]`: even over the window along the
        first coordinate, and along the second over what the lens sees there."""
        across = window[0, 0] + uniforms[0] * (window[1, 0] - window[0, 0])
        low, high = self._chord(across, 0, window, focus, radius)
        points = self._on_lens(torch.stack((across, low + uniforms[1] * (high - low))), focus)
        return torch.where(high > low, points, FAR_OUTSIDE)

    def pdf(self, points: Tensor, window: Tensor, focus: Tensor, radius: Tensor) -> Tensor:
        """Density `[P]` of `sample` at lens points `[2, P]`, per unit area of the lens plane."""
        place, stretch = self.coordinates(points, focus)
        low, high = self._chord(place[0], 0, window, focus, radius)
        inside = (place[0] >= window[0, 0]) & (place[0] <= window[1, 0]) & (place[1] >= low) & (place[1] <= high)
        share = 0.25 * (window[1, 0] - window[0, 0]) * (high - low)
        return torch.where(inside & (share > 0.0), stretch / share, 0.0)

    def size(self, window: Tensor, focus: Tensor, radius: Tensor) -> Tensor:
        """Area `[P]` of the lens that shows the windows, about."""
        width, offset, total = window[1, 0] - window[0, 0], self._centre - focus, 0.0
        for part in QUADRATURE:
            across = window[0, 0] + part * width
            low, high = self._chord(across, 0, window, focus, radius)
            # One over the stretch, by x_F alone: it is 0 where x_F lies in the plane.
            depth = offset[2] + across * self._right[2] + 0.5 * (low + high) * self._up[2]
            way = depth / focus[2]
            total = total + (high - low) * (dot(self._normal, offset) / (way * way * way * focus[2])).abs()
        return 0.25 / len(QUADRATURE) * width * self._area * total


class SeenPanels:
    """Those of M candidates that are panels, seen through x_F `[3, N]` of the pixels that own them.

    number: which of `panels` each candidate is, -1 for the others, int64 `[M]`; owner: int64 `[M]`. index: of K candidates, of
    which those at `real` are panels (see `worthwhile`); size: area of the lens plane that shows what of them the lens can see,
    about, `[K]`.
    """

    def __init__(self, panels: Panels, number: Tensor, owner: Tensor, focus: Tensor, radius: Tensor):
        self.index = worthwhile(number >= 0)
        number, self._owner = (values.index_select(0, self.index) for values in (number, owner))
        self.real = number >= 0
        self._panels, self._focus = panels.select(number.clamp(min=0)), focus.index_select(1, self._owner)
        self._radius = radius
        self._window, self.size = _seen(self._panels, self._focus, radius)

    def sample(self, place: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, J]` of those at `place` among the K, from uniform numbers `[2, J]`."""
        window, focus = self._window.index_select(2, place), self._focus.index_select(1, place)
        return self._panels.select(place).sample(window, focus, self._radius, uniforms)

    def pdf(self, points: Tensor) -> Tensor:
        """Densities `[K]` at the lens points `[2, N]` of the pixels, per unit area of the lens plane."""
        return _density(self._panels, points.index_select(1, self._owner), self._window, self._focus, self._radius)


@kernel
def _seen(panels: Panels, focus: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    window = panels.window(focus, radius)
    return window, panels.size(window, focus, radius)


@kernel
def _density(panels: Panels, points: Tensor, window: Tensor, focus: Tensor, radius: Tensor) -> Tensor:
    return panels.pdf(points, window, focus, radius)
