"""Shapes of the aperture, with their transmission and exact sampling.

Points are `[2, N]` in units of the pupil's radius, with x to the right and y up. The lens later rotates and squeezes the shape
(`lens.py`). Each shape has an `area`, the distance `reach` of its farthest point from the centre, and a transmission W with the
mean 1 over the area. The density of `sample` is W / area.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.vector import polar_angle

RIM = 1.0 - 1e-6
"""Largest distance of a sample from the centre, over the distance of the rim, so that rounding moves no sample outside."""


class Iris:
    """An opening bounded by equal arcs. The corners between the arcs lie on the unit circle.

    blades: number of arcs. The middle of one arc is on the right. 0: a disc. curvature: curvature of the arcs over curvature of
    the unit circle, 0 for straight blades. edge: W = 1 + edge · (2 t² - 1), where t is the distance from the centre over the
    distance of the rim. With -1, W is 0 at the rim. With 1, W is 0 in the centre.

    The code divides the opening into 2 · `blades` mirrored sectors, each between the middle and the end of an arc.
    """

    reach = 1.0

    def __init__(self, blades: int, curvature: float, edge: float):
        self.edge = edge
        self._blades, c = (blades, curvature) if blades else (2, 1.0)  # two half circles
        self._half = math.pi / self._blades
        height = math.sin(self._half)
        self._curvature = c
        self._middle = math.cos(self._half) + c * height**2 / (1.0 + math.sqrt(1.0 - (c * height) ** 2))
        """Distance of the middle of an arc from the centre."""
        self._end = math.asin(c * height) / c if c > 0.0 else height
        """Half the length of an arc."""
        self._sector = self._swept(self._end)
        self.area = 2 * self._blades * self._sector

    def sample(self, uniforms: Tensor) -> Tensor:
        """Points with density W / area from uniform numbers `[2, N]`."""
        place = uniforms[0] * (2 * self._blades)
        sector = place.floor()
        arc = self._arc_length(place - sector)
        x = self._middle - 0.5 * self._curvature * (arc * torch.sinc(arc * (0.5 * self._curvature / math.pi))).square()
        y = arc * torch.sinc(arc * (self._curvature / math.pi))
        t = RIM * self._share(uniforms[1]).sqrt()
        blade = (0.5 * sector).floor()
        mirror = 1.0 - 2.0 * (sector - 2.0 * blade)
        cos, sin = (2.0 * self._half * blade).cos(), (2.0 * self._half * blade).sin()
        return t * torch.stack((cos * x - sin * mirror * y, sin * x + cos * mirror * y))

    def transmission(self, points: Tensor) -> Tensor:
        """W, `[N]`."""
        x, y = points.unbind(0)
        angle = polar_angle(y, x)
        angle = angle - 2.0 * self._half * (angle / (2.0 * self._half)).round()
        # Polar form of the arc, valid for a straight one too.
        c, m = self._curvature, self._middle
        flat = 1.0 - c * m
        rim = m * (1.0 + flat) / (flat * angle.cos() + (1.0 - (flat * angle.sin()).square()).sqrt())
        share = (x * x + y * y) / (rim * rim)
        return torch.where(share <= 1.0, 1.0 + self.edge * (2.0 * share - 1.0), 0.0)

    def _swept(self, arc):
        """Area between the centre and an arc, from the middle of the arc to a length s along it; a number or a Tensor.

        The area is ½ [m s + d (s - R sin(s / R))]. m is the distance of the middle of the arc from the centre, R = 1 / curvature
        is the radius of the arc, and -d = m - R is the centre of the arc. The code uses a series in s / R, which is also valid
        for straight blades.
        """
        z = (self._curvature * arc) ** 2
        series = 1.0 - z / 20.0 * (1.0 - z / 42.0 * (1.0 - z / 72.0 * (1.0 - z / 110.0)))
        bend = self._curvature - self._middle * self._curvature**2
        return 0.5 * arc * (self._middle + bend * arc**2 / 6.0 * series)

    def _arc_length(self, share: Tensor) -> Tensor:
        """Length along an arc at which a sector has covered this share of its area, `[N]`.

        Two Newton steps are sufficient, because the area is nearly linear in the length. For straight blades and for the circle,
        it is exactly linear.
        """
        arc = share * self._end
        c, bend = self._curvature, self._curvature - self._middle * self._curvature**2
        for _ in range(2 if bend > 0.0 and c > 0.0 else 0):
            slope = 0.5 * (self._middle + 0.5 * bend * (arc * torch.sinc(arc * (0.5 * c / math.pi))).square())
            arc = arc - (self._swept(arc) - share * self._sector) / slope
        return arc

    def _share(self, uniforms: Tensor) -> Tensor:
        """Samples of t², the share of a sector's area within t, with a density proportional to W."""
        even = 1.0 - self.edge
        return 2.0 * uniforms / (even + (even * even + 4.0 * self.edge * uniforms).sqrt())


class Mask:
    """An image of the transmission with bilinear interpolation between the centres of texels. The longer side has the length 2.

    image: float `[H, W]`, non-negative and not all 0, top row first. The transmission outside the image is 0, so that the border
    fades over one texel. A cell is the square between four texel centres. The area consists of all cells with a positive texel.

    Bilinear interpolation is a sum of tent functions, one for each texel. `sample` chooses a texel in proportion to its value,
    and then a point with the density of the tent function.
    """

    def __init__(self, image: np.ndarray, device: torch.device | str):
        self._height, self._width = image.shape
        self._pitch = 2.0 / max(image.shape)
        padded = np.pad(image.astype(np.float64), 1)
        lit = padded > 0.0
        open_cells = lit[1:, 1:] | lit[1:, :-1] | lit[:-1, 1:] | lit[:-1, :-1]
        rows, columns = np.nonzero(open_cells)
        self.area = len(rows) * self._pitch**2
        farthest_y = np.abs(rows - 0.5 * self._height) + 0.5
        self.reach = float(np.hypot(np.abs(columns - 0.5 * self._width) + 0.5, farthest_y).max()) * self._pitch
        values = padded * (len(rows) / padded.sum())
        self._values = torch.from_numpy(values.astype(np.float32)).to(device)
        self._cumulative = torch.from_numpy(image.astype(np.float64).ravel().cumsum()).to(device)
        self._rows = self._cumulative[self._width - 1 :: self._width].contiguous()

    def sample(self, uniforms: Tensor) -> Tensor:
        """Points with density W / area from uniform numbers `[2, N]`."""
        width, cumulative = self._width, self._cumulative
        row, down = _choose(self._rows, 0.0, self._rows[-1], uniforms[1])
        low = _before(cumulative, row * width)
        texel, right = _choose(cumulative, low, self._rows[row], uniforms[0])
        x = (texel - row * width) + 0.5 - 0.5 * width + _tent(right)
        y = 0.5 * self._height - row - 0.5 - _tent(down)
        return (self._pitch * torch.stack((x, y))).float()

    def transmission(self, points: Tensor) -> Tensor:
        """W, `[N]`."""
        column = (points[0] / self._pitch + 0.5 * self._width + 0.5).clamp(0.0, self._width + 1.0)
        row = (0.5 * self._height - points[1] / self._pitch + 0.5).clamp(0.0, self._height + 1.0)
        left, top = column.floor().clamp(max=self._width).long(), row.floor().clamp(max=self._height).long()
        right, down = column - left, row - top
        upper = torch.lerp(self._values[top, left], self._values[top, left + 1], right)
        lower = torch.lerp(self._values[top + 1, left], self._values[top + 1, left + 1], right)
        return torch.lerp(upper, lower, down)


def _before(cumulative: Tensor, index: Tensor) -> Tensor:
    """Sum of all values before each index."""
    return torch.where(index > 0, cumulative[(index - 1).clamp(min=0)], 0.0)


def _choose(cumulative: Tensor, low: Tensor | float, high: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
    """Indices drawn by inversion of `cumulative` between the sums low and high; and remainders of the numbers, in 0 … 1."""
    target = low + (high - low) * uniforms.double()
    index = torch.searchsorted(cumulative, target, right=True).clamp(max=len(cumulative) - 1)
    start = _before(cumulative, index)
    return index, ((target - start) / (cumulative[index] - start)).clamp(0.0, 1.0)


def _tent(uniforms: Tensor) -> Tensor:
    """Numbers x in -1 … 1 with the density 1 - |x|, from uniform numbers."""
    half = 1.0 - (1.0 - (2.0 * uniforms - 1.0).abs()).sqrt()
    return torch.where(uniforms < 0.5, -half, half)
