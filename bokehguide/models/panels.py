"""Flat lamps of four corners, a window or a soft box, seen through a focus point on the lens in their own shape.

The line from a lens point through x_F meets a panel's plane in one point, so that a density over the panel is one over
the lens plane: exactly, however near or tilted the panel is.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.models.projection import project_to_lens
from bokehguide.render.kernels import kernel, record
from bokehguide.render.pixels import indices
from bokehguide.render.vector import cross, dot

ROUNDING = 1e-6
"""Of what lens points are rounded to, by their size: 16 times as much."""


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

        radius: of the lens, `[]`.
        """
        radius = 1.0001 * radius
        low = torch.full_like(focus[:2], torch.inf)
        high = -low
        sides = []
        for x in (-radius, radius):
            for y in (-radius, radius):
                corner = torch.stack((x.expand_as(focus[0]), y.expand_as(focus[0])))
                place, _ = self.coordinates(corner, focus)
                low, high = torch.minimum(low, place), torch.maximum(high, place)
                sides.append(dot(self._normal, torch.cat((focus[:2] - corner, focus[2:3]))) > 0.0)
        # Where the lens's square reaches across the plane its image has no bounds.
        whole = torch.stack(sides).sum(0) % 4 != 0
        window = torch.stack((torch.where(whole, -torch.inf, low), torch.where(whole, torch.inf, high)))
        most = 1.0 + self._margin(focus, radius)
        return torch.maximum(torch.minimum(window.nan_to_num(0.0), most), -most)

    def sample(self, window: Tensor, focus: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, P]` that see panels through x_F `[3, P]`, even over windows, from uniform numbers `[2, P]`."""
        place = window[0] + uniforms * (window[1] - window[0])
        offset, aside = self._centre - focus, place[0] * self._right + place[1] * self._up
        shift = (offset[:2] * (aside[2] / offset[2]) - aside[:2]) * (focus[2] / (offset[2] + aside[2]))
        return project_to_lens(self._centre, focus) + shift

    def pdf(self, points: Tensor, window: Tensor, focus: Tensor) -> Tensor:
        """Density `[P]` of `sample` at lens points `[2, P]`, per unit area of the lens plane."""
        place, stretch = self.coordinates(points, focus)
        inside = ((place >= window[0]) & (place <= window[1])).all(0)
        share = 0.25 * (window[1] - window[0]).prod(0)
        return torch.where(inside & (share > 0.0), stretch / share, 0.0)

    def size(self, window: Tensor, focus: Tensor) -> Tensor:
        """Area `[P]` of the lens plane that shows the windows, about."""
        middle = window.mean(0)
        offset = self._centre + middle[0] * self._right + middle[1] * self._up - focus
        way = offset[2] / focus[2]
        # One over the stretch at the window's middle, by x_F alone: it is 0 where x_F lies in the plane.
        area = self._area * (dot(self._normal, offset) / (way * way * way * focus[2])).abs()
        return 0.25 * (window[1] - window[0]).prod(0) * area


class SeenPanels:
    """Those of M candidates that are panels, seen through x_F `[3, N]` of the pixels that own them.

    number: which of `panels` each candidate is, -1 for the others, int64 `[M]`; owner: int64 `[M]`. index: of the K
    candidates that are panels; size: area of the lens plane that shows what of them the lens can see, about, `[K]`.
    """

    def __init__(self, panels: Panels, number: Tensor, owner: Tensor, focus: Tensor, radius: Tensor):
        self.index = indices(number >= 0)
        self._owner = owner.index_select(0, self.index)
        self._panels, self._focus = panels.select(number.index_select(0, self.index)), focus.index_select(1, self._owner)
        self._window, self.size = _seen(self._panels, self._focus, radius)

    def sample(self, place: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, J]` of those at `place` among the K, from uniform numbers `[2, J]`."""
        window, focus = self._window.index_select(2, place), self._focus.index_select(1, place)
        return self._panels.select(place).sample(window, focus, uniforms)

    def pdf(self, points: Tensor) -> Tensor:
        """Densities `[K]` at the lens points `[2, N]` of the pixels, per unit area of the lens plane."""
        return _density(self._panels, points.index_select(1, self._owner), self._window, self._focus)


@kernel
def _seen(panels: Panels, focus: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    window = panels.window(focus, radius)
    return window, panels.size(window, focus)


@kernel
def _density(panels: Panels, points: Tensor, window: Tensor, focus: Tensor) -> Tensor:
    return panels.pdf(points, window, focus)
